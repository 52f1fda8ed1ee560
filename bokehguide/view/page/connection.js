// The WebSocket: JSON texts to the server; JSON texts, or pictures with a JSON text before them, from the server.

export class Connection {
  // handlers: functions by the type of a message; they receive the facts and, for a picture, a Blob.
  constructor(handlers, onStatus) {
    this.handlers = handlers;
    this.onStatus = onStatus;
    this.queue = []; // changes that wait for the answer to the one before
    this.waits = false;
    this.open();
  }

  open() {
    const address = new URL("socket" + location.search, location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.queue = [];
      this.waits = false;
      this.onStatus(true);
    };
    this.socket.onclose = () => {
      this.onStatus(false);
      setTimeout(() => this.open(), 1000);
    };
    this.socket.onmessage = (event) => this.receive(event.data);
  }

  receive(data) {
    let facts, picture = null;
    if (typeof data === "string") {
      facts = JSON.parse(data);
    } else {
      const length = new DataView(data).getUint32(0, true);
      facts = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      picture = new Blob([new Uint8Array(data, 4 + length)], { type: "image/png" });
    }
    this.handlers[facts.type]?.(facts, picture);
    if (facts.type === "state" || facts.type === "failure") {
      this.waits = false;
      this.pump();
    }
  }

  // Changes go one by one; while one is on its way, later ones of its kind become one.
  send(request) {
    if (!["set", "move"].includes(request.type)) {
      this.post(request);
      return;
    }
    const last = this.queue.at(-1);
    const moved = this.queue.slice(-2).find((each) => each.type === "move" && request.type === "move" && each.kind === request.kind);
    if (moved && last.type === "move") { // two fingers alternate between two kinds
      moved.x += request.x;
      moved.y += request.y;
    } else if (last && last.type === "set" && last.name === request.name) {
      last.value = request.value;
    } else {
      this.queue.push({ ...request });
    }
    this.pump();
  }

  pump() {
    if (!this.waits && this.queue.length > 0) {
      this.waits = true;
      this.post(this.queue.shift());
    }
    document.body.dataset.pending = this.queue.length + (this.waits ? 1 : 0);
  }

  post(request) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(request));
  }
}
