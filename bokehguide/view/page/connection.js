// The WebSocket: JSON texts to the server; JSON texts, or pictures with a JSON text before them, from the server.

export class Connection {
  // handlers: functions by the type of a message; they receive the facts and, for a picture, a Blob.
  constructor(handlers, onStatus) {
    this.handlers = handlers;
    this.onStatus = onStatus;
    this.open();
  }

  open() {
    const address = new URL("socket" + location.search, location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.onStatus(true);
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
  }

  send(request) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(request));
  }
}
