// The controls of the sidebar: each number has a slider and a field. The values come from the server, which knows their limits.

const log = { to: (value) => Math.log(value), from: (place) => Math.exp(place) };
const even = { to: (value) => value, from: (place) => place };

// Ranges of the sliders; the fields take what the server takes. `about` spreads a range about the first value of a scene.
// `empty` tells what an empty field means.
const CONTROLS = {
  focus_distance: { label: "Focus", unit: "m", scale: log, digits: 4, about: [0.1, 20], empty: "∞" },
  f_number: { label: "f-number", unit: "", scale: log, digits: 3, low: 0.7, high: 32, about: [0.25, 16], empty: "pinhole" },
  focal_length: { label: "Focal length", unit: "mm", scale: log, digits: 3, low: 12, high: 300 },
  fov: { label: "Field of view", unit: "°", scale: even, digits: 3, low: 5, high: 110 },
  blades: { label: "Blades", unit: "", scale: even, step: 1, whole: true, low: 0, high: 12, digits: 2 },
  rotation: { label: "Rotation", unit: "°", scale: even, digits: 4, low: -180, high: 180 },
  curvature: { label: "Curvature", unit: "", scale: even, digits: 3, low: 0, high: 1 },
  ratio: { label: "Ratio", unit: "×", scale: log, digits: 3, low: 0.5, high: 2 },
  cat_eye: { label: "Cat’s eye", unit: "", scale: even, digits: 3, low: 0, high: 1.5 },
  edge: { label: "Edge", unit: "", scale: even, digits: 3, low: -1, high: 1 },
  environment_rotation: { label: "Sky rotation", unit: "°", scale: even, digits: 4, low: -180, high: 180 },
  exposure: { label: "Exposure", unit: "EV", scale: even, digits: 3, low: -8, high: 8, empty: "auto" },
  spp: { label: "Samples", unit: "SPP", scale: log, whole: true, low: 1, high: 4096, digits: 5 },
};

export class Controls {
  // send: receives requests.
  constructor(send) {
    this.send = send;
    this.parts = {};
    for (const holder of document.querySelectorAll("[data-control]")) this.make(holder, holder.dataset.control);
    for (const name of ["view", "mode"]) {
      document.getElementById(name).addEventListener("change", (event) => this.set(name, event.target.value));
    }
    document.getElementById("denoise").addEventListener("change", (event) => this.set("denoise", event.target.checked));
    document.getElementById("auto").addEventListener("change", (event) => this.set("exposure", event.target.checked ? null : this.metered ?? 0));
    document.getElementById("infinity").addEventListener("click", () => this.set("focus_distance", null));
    document.getElementById("form").addEventListener("submit", (event) => event.preventDefault());
  }

  make(holder, name) {
    const kind = { ...CONTROLS[name] };
    holder.className = "control";
    const label = Object.assign(document.createElement("label"), { textContent: kind.label, htmlFor: name });
    const slider = Object.assign(document.createElement("input"), { type: "range", min: 0, max: 1000, step: kind.step && kind.high <= 100 ? 1000 / (kind.high - kind.low) : 1 });
    slider.setAttribute("aria-label", `${kind.label}, slider`);
    const field = Object.assign(document.createElement("input"), { type: "number", id: name, step: kind.whole ? 1 : "any" });
    const unit = Object.assign(document.createElement("span"), { className: "unit", textContent: kind.unit });
    holder.append(label, slider, field, unit);
    this.parts[name] = { kind, slider, field, holder };
    slider.addEventListener("input", () => this.set(name, this.value(name)));
    field.addEventListener("change", () => {
      this.edited = this.parts[name];
      if (field.value !== "") this.set(name, Number(field.value));
      else if (kind.empty && !field.validity.badInput) this.set(name, null);
    });
    field.addEventListener("blur", () => this.write(this.parts[name]));
  }

  range({ kind }) {
    return [kind.scale.to(kind.low), kind.scale.to(kind.high)];
  }

  value(name) {
    const part = this.parts[name];
    const [low, high] = this.range(part);
    const value = part.kind.scale.from(low + ((high - low) * part.slider.value) / 1000);
    return part.kind.whole ? Math.round(value) : Number(value.toPrecision(part.kind.digits));
  }

  // Ask for a value. A slider asks as often as it moves; the server shows the latest.
  set(name, value) {
    this.send({ type: "set", name, value });
  }

  greet(facts) {
    this.fill("view", facts.views);
    this.fill("mode", facts.modes);
    this.denoiser = facts.denoiser;
    this.parts.environment_rotation.holder.hidden = !facts.environment;
    for (const id of ["lens", "aperture", "tools", "reset"]) document.getElementById(id).hidden = facts.follows;
    for (const part of [document.getElementById("mode").parentElement, this.parts.spp.holder]) part.hidden = facts.follows;
    for (const id of ["render", "undo", "save_picture", "save_scene"]) document.getElementById(id).hidden = facts.follows;
  }

  fill(name, names) {
    document.getElementById(name).replaceChildren(...names.map((each) => new Option(each, each)));
  }

  // Show the values of the server. A field that is being edited keeps its text.
  show({ values, rendering, marked }) {
    for (const [name, part] of Object.entries(this.parts)) {
      if (!(name in values)) continue;
      this.spread(part, values[name]);
      const value = values[name];
      const [low, high] = this.range(part);
      if (document.activeElement !== part.slider && value !== null) {
        part.slider.value = (1000 * (part.kind.scale.to(value) - low)) / (high - low);
      }
      part.text = value === null ? "" : String(Number(value.toPrecision(part.kind.digits)));
      part.slider.setAttribute("aria-valuetext", value === null ? "none" : `${part.text} ${part.kind.unit}`);
      if (document.activeElement !== part.field || part.field.value === "") this.write(part);
      part.field.placeholder = value === null ? part.kind.empty ?? "" : "";
    }
    const round = !values.blades && !values.has_mask;
    this.enable("rotation", !round);
    this.enable("curvature", Boolean(values.blades));
    for (const name of ["blades", "ratio", "cat_eye", "edge"]) this.enable(name, values.f_number !== null);
    this.enable("exposure", values.exposure !== null);
    document.getElementById("auto").checked = values.exposure === null;
    document.getElementById("denoise").checked = values.denoise;
    document.getElementById("marked").checked = marked;
    for (const name of ["view", "mode"]) document.getElementById(name).value = values[name];
    this.rendering = rendering;
    this.lock();
  }

  // The present value; a text that was refused does not stay.
  write({ field, text }) {
    field.value = text ?? "";
    field.removeAttribute("aria-invalid");
  }

  // A message that begins with an option, with the label of its field instead.
  labelled(text) {
    return text.replace(/^(?:aperture_)?(\w+) or --[\w-]+(?=:)/, (option, name) => CONTROLS[name]?.label ?? option);
  }

  // Mark the field whose value the server refuses, until it is left.
  refuse() {
    if (this.edited && document.activeElement === this.edited.field) this.edited.field.setAttribute("aria-invalid", "true");
  }

  spread({ kind }, value) {
    if (!kind.about || value === null || kind.spread) return;
    kind.spread = true;
    kind.low = Math.min(kind.low ?? Infinity, value * kind.about[0]);
    kind.high = Math.max(kind.high ?? 0, value * kind.about[1]);
  }

  enable(name, on) {
    const { slider, field, holder } = this.parts[name];
    slider.disabled = field.disabled = !on;
    holder.classList.toggle("off", !on);
  }

  steers(steers) {
    this.steering = steers;
    this.lock();
  }

  // A render keeps its camera, lens and denoising; a browser that does not steer keeps everything.
  lock() {
    for (const id of ["lens", "aperture"]) document.getElementById(id).disabled = this.rendering || !this.steering;
    for (const id of ["light", "making"]) document.getElementById(id).disabled = !this.steering;
    for (const id of ["mode", "reset"]) document.getElementById(id).disabled = this.rendering;
    document.getElementById("denoise").disabled = this.rendering || !this.denoiser;
    for (const name of ["spp", "environment_rotation"]) this.enable(name, !this.rendering);
  }
}
