// The page of `bokehguide view`.

import { Connection } from "./connection.js";
import { Controls } from "./controls.js";
import { showAge, showPixel, showStats } from "./panels.js";
import { Stage } from "./stage.js";

const HOVER = 120; // milliseconds between two questions about the pixel under the pointer
const AGAIN = 500; // the same, while the pointer rests and the picture changes
const NAMES = { picture: "Picture", depth: "Depth", normal: "Normal", albedo: "Albedo", emission: "Emission", variance: "Variance", beta: "β", emitters: "Emitters" };
const TOOLS = { orbit: "Orbit", pan: "Pan", dolly: "Dolly", look: "Look", inspect: "Inspect" };
const LEGENDS = {
  depth: "Near is bright; black has no surface.",
  normal: "Red, green and blue are the components along x, y and z; middle grey is zero.",
  albedo: "The share of light that surfaces reflect.",
  emission: "The light of emitters that the pixel sees directly.",
  variance: "The relative standard error; bright pixels need more samples.",
  beta: "The share of guided samples; black pixels are sampled evenly.",
  emitters: "Bright pixels may see more emitters through the lens; highlights that were found are red.",
};
const find = (id) => document.getElementById(id);

let connection = null;
const send = (request) => connection.send(request);
const stage = new Stage(send);
const controls = new Controls(send);
let asked = 0; // time of the open question about a pixel, 0 without one
let inspected = null; // the latest question: its place, its time, and the picture that it was about
let state = null;
let facts = null;

function note(text, bad = false) {
  const place = find("note");
  place.textContent = text;
  place.classList.toggle("bad", bad);
  clearTimeout(note.timer);
  note.timer = setTimeout(() => (place.textContent = ""), bad ? 8000 : 5000);
}

function radios(holder, names, chosen, choose) {
  const group = holder.id;
  holder.replaceChildren(...Object.entries(names).map(([value, text]) => {
    const label = document.createElement("label");
    const input = Object.assign(document.createElement("input"), { type: "radio", name: group, value, checked: value === chosen });
    input.addEventListener("change", () => choose(value));
    label.append(input, Object.assign(document.createElement("span"), { textContent: text }));
    return label;
  }));
}

const handlers = {
  hello(message) {
    find("scene").textContent = message.scene;
    document.title = `${message.scene} – bokehguide view`;
    stage.greet(message);
    for (const id of ["speed_entry", "keys"]) find(id).hidden = message.follows;
    controls.greet(message);
    const layers = Object.fromEntries(message.layers.map((name) => [name, NAMES[name] ?? name]));
    radios(find("layers"), layers, "picture", (value) => send({ type: "set", name: "layer", value }));
  },
  state(message) {
    state = message;
    document.body.dataset.state = message.revision;
    controls.show(message);
    find("command").value = message.command;
    find("undo").disabled = !message.changes;
    const layer = document.querySelector(`#layers input[value="${message.values.layer}"]`);
    if (layer) layer.checked = true;
    find("legend").textContent = LEGENDS[message.values.layer] ?? "";
    showButton();
  },
  picture(message, blob) {
    facts = message;
    controls.metered = message.exposure;
    showStats(message);
    stage.show(message, blob);
    showButton();
    document.body.dataset.revision = message.revision;
    document.body.dataset.spp = message.reduction > 1.001 ? 0 : message.spp;
  },
  marker(message, blob) {
    stage.mark(message.on, blob);
  },
  role(message) {
    controls.steers(message.steers);
    const others = message.browsers - 1;
    const also = others === 1 ? "one other browser watches" : `${others} other browsers watch`;
    find("role").textContent = message.steers ? (others ? also : "") : "Watching: another browser steers";
    find("steer").hidden = message.steers;
    for (const input of document.querySelectorAll("#layers input")) input.disabled = !message.steers;
  },
  pixel(message) {
    asked = 0;
    showPixel(message);
  },
  note: (message) => note(message.note),
  failure(message) {
    asked = 0;
    note(controls.labelled(message.failure), true);
    if (state) controls.show(state);
    controls.refuse();
  },
};

// "Render" becomes "Stop" while a render runs, and "Continue" after a stop.
function showButton() {
  find("render").textContent = state?.rendering ? "Stop" : state?.paused ? "Continue" : "Render";
}

function undo() {
  if (!find("undo").matches(":disabled")) send({ type: "undo" });
}

async function copy() {
  const field = find("command");
  try {
    await navigator.clipboard.writeText(field.value);
  } catch {
    field.select();
    document.execCommand("copy");
  }
  note("Copied the command");
}

radios(find("tools"), TOOLS, "orbit", (value) => {
  stage.tool = value;
  find("drag").textContent = value === "inspect" ? "show values" : value;
});
find("render").addEventListener("click", () => send({ type: "render", on: !state?.rendering }));
find("save_picture").addEventListener("click", () => send({ type: "save_picture" }));
find("save_scene").addEventListener("click", () => send({ type: "save_scene" }));
find("undo").addEventListener("click", undo);
addEventListener("keydown", (event) => {
  // A field with its own history keeps the key.
  const typing = event.target.matches?.("input[type=number], textarea");
  if (typing || !(event.ctrlKey || event.metaKey) || event.shiftKey || event.altKey || event.key.toLowerCase() !== "z") return;
  event.preventDefault();
  undo();
});
find("reset").addEventListener("click", () => send({ type: "reset" }));
find("marked").addEventListener("change", (event) => send({ type: "mark", on: event.target.checked }));
find("steer").addEventListener("click", () => send({ type: "steer" }));
find("copy").addEventListener("click", copy);

setInterval(showAge, 1000);
setInterval(() => {
  const now = performance.now();
  if (stage.start || (asked && now - asked < 3000)) return;
  // The values of a picture change when its state, its size, or its end does; the steps between are left out.
  const picture = facts && [facts.revision, facts.reduction, facts.done].join();
  const outdated = inspected && inspected.picture !== picture && now - inspected.time > AGAIN;
  const place = stage.place ?? (outdated ? inspected.place : null);
  if (!place) return;
  stage.place = null;
  inspected = { place, picture, time: now };
  asked = now;
  send({ type: "hover", x: place[0], y: place[1] });
}, HOVER);

connection = new Connection(handlers, (open) => {
  document.body.dataset.connected = open;
  for (const part of [find("layers"), find("tools"), find("frame"), find("form")]) part.inert = !open; // changes would be lost
  if (!open) note("The connection is lost; trying again …", true);
  else find("note").textContent = "";
});
