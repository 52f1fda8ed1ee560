// The picture: shows frames, and turns the pointer and keys into requests.

const STILL = 4; // pixels that a click may move
const WALK = 0.04; // of the distance to the target, for each repeat of a key
const STEP = 0.01; // of the frame, of a key that moves the inspected point; five times as far with Shift
const ARROWS = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, -STEP], ArrowDown: [0, STEP] };
const KEYS = {
  w: ["walk", 0, -WALK], s: ["walk", 0, WALK], a: ["walk", -WALK, 0], d: ["walk", WALK, 0], q: ["rise", 0, WALK], e: ["rise", 0, -WALK],
  ArrowLeft: ["orbit", -0.02, 0], ArrowRight: ["orbit", 0.02, 0], ArrowUp: ["orbit", 0, -0.02], ArrowDown: ["orbit", 0, 0.02],
  "+": ["dolly", 0, -0.03], "-": ["dolly", 0, 0.03],
};

export class Stage {
  constructor(send) {
    this.send = send;
    this.tool = "orbit";
    this.point = [0.5, 0.5]; // what the keys inspect, in fractions of the frame
    this.frame = document.getElementById("frame");
    this.picture = document.getElementById("picture");
    this.marker = document.getElementById("marker");
    this.reticle = document.getElementById("reticle");
    this.pixel = document.getElementById("pixel_panel");
    this.pending = null;
    this.fingers = new Map(); // places of the pointers that are down, by their number
    this.shown = 0;
    this.frame.addEventListener("pointerdown", (event) => this.down(event));
    this.frame.addEventListener("pointermove", (event) => this.move(event));
    this.frame.addEventListener("pointerup", (event) => this.up(event));
    this.frame.addEventListener("pointercancel", (event) => this.lift(event));
    this.frame.addEventListener("pointerleave", () => (this.place = null));
    this.frame.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.frame.addEventListener("contextmenu", (event) => event.preventDefault());
    this.frame.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.fit()).observe(this.frame.parentElement);
    addEventListener("resize", () => this.fit());
  }

  greet({ width, height, follows }) {
    this.size = [width, height];
    this.still = follows; // the camera of a render elsewhere cannot be set
    if (follows) {
      this.tool = "inspect";
      this.frame.setAttribute("aria-label", "Picture: arrow keys inspect");
    }
    for (const canvas of [this.picture, this.marker]) [canvas.width, canvas.height] = [width, height];
    this.fit();
  }

  // As large as the page allows, and at most eight pixels of the screen for one of the picture.
  fit() {
    if (!this.size) return;
    const [width, height] = this.size;
    const stage = this.frame.parentElement;
    const narrow = matchMedia("(max-width: 860px)").matches;
    const others = narrow ? 0 : [...stage.children, this.pixel].reduce((sum, each) => sum + (each === this.frame ? 0 : each.offsetHeight + 8), 0);
    const room = narrow ? innerHeight * 0.45 : innerHeight - this.frame.getBoundingClientRect().top - others - 24;
    const space = stage.clientWidth - (narrow ? 0 : 32);
    const scale = Math.max(Math.min(space / width, room / height, 8), 0.1);
    this.frame.style.width = `${Math.floor(width * scale)}px`;
    this.frame.style.height = `${Math.floor(height * scale)}px`;
  }

  async show(facts, blob) {
    const number = ++this.shown;
    const image = await createImageBitmap(blob);
    if (number < this.drawn) return; // a later picture was faster
    this.drawn = number;
    const pen = this.picture.getContext("2d");
    pen.imageSmoothingQuality = "high";
    pen.drawImage(image, 0, 0, this.picture.width, this.picture.height);
    image.close();
    document.body.dataset.drawn = facts.exact ? facts.revision : "";
    document.getElementById("waiting").hidden = true;
  }

  async mark(on, blob) {
    const pen = this.marker.getContext("2d", { willReadFrequently: true });
    const image = on && blob ? await createImageBitmap(blob) : null;
    pen.clearRect(0, 0, this.marker.width, this.marker.height);
    if (!image) return;
    pen.imageSmoothingEnabled = false;
    pen.drawImage(image, 0, 0, this.marker.width, this.marker.height);
    const pixels = pen.getImageData(0, 0, this.marker.width, this.marker.height);
    for (let i = 0; i < pixels.data.length; i += 4) {
      pixels.data[i + 3] = pixels.data[i];
      [pixels.data[i], pixels.data[i + 1], pixels.data[i + 2]] = [64, 224, 255];
    }
    pen.putImageData(pixels, 0, 0);
    image.close();
  }

  at(event) {
    const box = this.frame.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  down(event) {
    this.frame.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.fingers.size > 1) {
      this.start = null; // two fingers pan and dolly, and focus nowhere
      return;
    }
    this.start = { x: event.clientX, y: event.clientY, moved: false };
    const tool = event.button > 0 || event.shiftKey ? "pan" : event.ctrlKey ? "look" : this.tool;
    this.start.tool = tool;
  }

  move(event) {
    this.place = this.at(event);
    if (this.fingers.size > 1) {
      this.pinch(event);
      return;
    }
    const { start } = this;
    if (!start) return;
    const [dx, dy] = [event.clientX - start.x, event.clientY - start.y];
    if (!start.moved && Math.hypot(dx, dy) < STILL) return;
    start.moved = true;
    [start.x, start.y] = [event.clientX, event.clientY];
    const width = this.frame.clientWidth;
    if (start.tool !== "inspect") this.queue(start.tool, dx / width, dy / width);
  }

  // Two fingers: their distance is a dolly, and their middle is a pan.
  pinch(event) {
    if (!this.fingers.has(event.pointerId)) return;
    const [[x, y], other] = [this.fingers.get(event.pointerId), [...this.fingers].find(([id]) => id !== event.pointerId)[1]];
    const now = [event.clientX, event.clientY];
    this.fingers.set(event.pointerId, now);
    const apart = (place) => Math.max(Math.hypot(place[0] - other[0], place[1] - other[1]), 1);
    const width = this.frame.clientWidth;
    this.queue("dolly", 0, Math.log(apart([x, y]) / apart(now)) / Math.log(4));
    this.queue("pan", (now[0] - x) / (2 * width), (now[1] - y) / (2 * width));
  }

  lift(event) {
    this.fingers.delete(event.pointerId);
    this.start = null;
  }

  up(event) {
    const { start } = this;
    this.lift(event);
    if (start && !start.moved && event.button === 0 && start.tool !== "inspect") this.focus(...this.at(event));
  }

  aim(x, y) {
    this.reticle.hidden = false;
    this.reticle.style.left = `${100 * x}%`;
    this.reticle.style.top = `${100 * y}%`;
  }

  // Move the inspected point, and ask for its values.
  inspect([x, y], times) {
    const within = (value) => Math.min(Math.max(value, 0), 1);
    this.point = [within(this.point[0] + times * x), within(this.point[1] + times * y)];
    this.place = [...this.point];
    this.aim(...this.point);
  }

  focus(x, y) {
    if (this.still) return;
    this.aim(x, y);
    this.send({ type: "focus", x, y });
  }

  wheel(event) {
    event.preventDefault();
    this.queue("dolly", 0, Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY) / 2000, 0.1));
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const inspects = this.tool === "inspect";
    const motion = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (inspects && ARROWS[event.key]) this.inspect(ARROWS[event.key], event.shiftKey ? 5 : 1);
    else if (motion) this.queue(...motion);
    else if (event.key === "Enter") this.focus(...(inspects ? this.point : [0.5, 0.5]));
    else if (event.key.toLowerCase() === "p") document.getElementById("marked").click();
    else return;
    event.preventDefault();
  }

  // Sum up movements of one kind until the next frame of the screen.
  queue(kind, x, y) {
    if (this.still) return;
    if (this.pending && this.pending.kind !== kind) this.flush();
    if (!this.pending) {
      this.pending = { type: "move", kind, x: 0, y: 0 };
      requestAnimationFrame(() => this.flush());
    }
    this.pending.x += x;
    this.pending.y += y;
    this.reticle.hidden = true;
  }

  flush() {
    if (this.pending) this.send(this.pending);
    this.pending = null;
  }
}
