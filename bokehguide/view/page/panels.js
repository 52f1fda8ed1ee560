// What stands beside the picture: numbers, the convergence curve, and the values and the lens of a pixel.

const SUPERSCRIPT = new Intl.NumberFormat("en", { notation: "compact", maximumFractionDigits: 1 });

let written = null; // when the file of another render was written, in the time of the page

// How long ago the file was written: a render that has ended or died writes no more.
export function showAge() {
  if (written === null) return;
  const seconds = Math.round((performance.now() - written) / 1000);
  const [number, unit] = seconds < 100 ? [seconds, "s"] : seconds < 6000 ? [Math.round(seconds / 60), "min"] : [Math.round(seconds / 3600), "h"];
  document.getElementById("seconds").textContent = `${number} ${unit} ago`;
}

export function showStats(facts) {
  const put = (id, text) => (document.getElementById(id).textContent = text);
  put("samples", facts.reduction > 1.001 ? `1/${Math.round(facts.reduction)} size` : facts.limit ? `${facts.spp} / ${facts.limit}` : "–");
  put("error", facts.error === null ? "–" : `${(100 * facts.error).toPrecision(2)} %`);
  put("speed", facts.rays_per_second ? `${SUPERSCRIPT.format(facts.rays_per_second)} rays/s` : "–");
  put("time_name", facts.age === undefined ? "Time" : "Written");
  written = facts.age === undefined ? null : performance.now() - 1000 * facts.age;
  if (written === null) put("seconds", `${facts.seconds.toFixed(1)} s`);
  showAge();
  put("metered", `${facts.exposure >= 0 ? "+" : "−"}${Math.abs(facts.exposure).toFixed(2)} EV`);
  document.getElementById("progress").style.width = `${Math.min(100, (100 * facts.spp) / Math.max(facts.limit, 1))}%`;
  drawCurve(facts.curve);
}

// Error by samples, both in logarithms. The grey line falls as 1 / √samples.
function drawCurve(curve) {
  const canvas = document.getElementById("curve");
  const pen = canvas.getContext("2d");
  const { width, height } = canvas;
  pen.clearRect(0, 0, width, height);
  if (curve.length < 2) return;
  const points = curve.filter(([, error]) => error > 0).map(([step, error]) => [Math.log(step), Math.log(error)]);
  if (points.length < 2) return;
  const [left, right] = [points[0][0], points.at(-1)[0]];
  const top = Math.max(...points.map(([, y]) => y));
  const bottom = Math.min(...points.map(([, y]) => y), top - 0.5 * (right - left));
  const x = (value) => 4 + ((width - 8) * (value - left)) / (right - left);
  const y = (value) => 4 + ((height - 8) * (top - value)) / Math.max(top - bottom, 1e-6);
  const line = (list, color) => {
    pen.beginPath();
    list.forEach(([a, b], index) => (index ? pen.lineTo(x(a), y(b)) : pen.moveTo(x(a), y(b))));
    pen.strokeStyle = color;
    pen.lineWidth = 3;
    pen.stroke();
  };
  line([[left, points[0][1]], [right, points[0][1] - 0.5 * (right - left)]], "#555");
  line(points, "#f2b04b");
  const [first, last] = [curve[0], curve.at(-1)].map(([step, error]) => `${(100 * error).toPrecision(2)} % at ${step} SPP`);
  canvas.setAttribute("aria-label", `Estimated error from ${first} to ${last}`);
}

const number = (value) => (value === null || value === undefined ? "–" : Math.abs(value) >= 1e5 || (value && Math.abs(value) < 1e-3) ? value.toExponential(2) : value.toPrecision(4));
const triple = (values) => values.map(number).join(" ");

export function showPixel(facts) {
  const rows = [["Pixel", `${facts.pixel.join(", ")} of ${facts.reduced.join("×")}`]];
  if (facts.beauty) rows.push(["Radiance", triple(facts.beauty)]);
  rows.push(["Depth", facts.depth === null ? "no surface" : `${number(facts.depth)} m`]);
  if (facts.confusion !== undefined && facts.confusion !== null) rows.push(["Blur disc", `${number(facts.confusion)} px`]);
  for (const [name, key] of [["Normal", "normal"], ["Albedo", "albedo"]]) if (facts[key]) rows.push([name, triple(facts[key])]);
  if (facts.variance !== undefined) rows.push(["Variance", number(facts.variance)]);
  if (facts.sample_count !== undefined) rows.push(["Samples", String(facts.sample_count)]);
  if (facts.beta !== undefined) rows.push(["β (guided share)", number(facts.beta)]);
  document.getElementById("pixel").replaceChildren(...rows.map(([name, value]) => {
    const entry = document.createElement("div");
    entry.append(...[["dt", name], ["dd", value]].map(([tag, text]) => Object.assign(document.createElement(tag), { textContent: text })));
    return entry;
  }));
  drawDisc(facts.lens);
}

// From black over violet and orange to white, by the logarithm of the density.
const STOPS = [[12, 8, 28], [80, 18, 123], [182, 54, 121], [251, 136, 97], [252, 253, 191]];
function color(share) {
  const place = share * (STOPS.length - 1);
  const index = Math.min(Math.floor(place), STOPS.length - 2);
  return STOPS[index].map((from, channel) => from + (STOPS[index + 1][channel] - from) * (place - index));
}

function drawDisc(lens) {
  const canvas = document.getElementById("disc");
  const pen = canvas.getContext("2d");
  const note = document.getElementById("disc_note");
  pen.clearRect(0, 0, canvas.width, canvas.height);
  if (!lens) {
    note.textContent = lens === null ? "A pinhole has one lens point." : "The file does not tell where on the lens its samples went.";
    return;
  }
  const cells = Uint8Array.from(atob(lens.cells), (mark) => mark.charCodeAt(0));
  const small = new ImageData(lens.grid, lens.grid);
  cells.forEach((cell, index) => {
    if (!cell) return;
    small.data.set([...color((cell - 1) / 254), 255], 4 * index);
  });
  const source = new OffscreenCanvas(lens.grid, lens.grid);
  source.getContext("2d").putImageData(small, 0, 0);
  pen.imageSmoothingEnabled = false;
  pen.drawImage(source, 0, 0, canvas.width, canvas.height);
  pen.fillStyle = "#7fe0ff";
  const half = canvas.width / 2;
  for (const [x, y] of lens.draws) pen.fillRect(half + x * half - 1, half - y * half - 1, 2, 2);
  const share = lens.highest < 1.05 ? "this pixel samples it evenly" : `brighter is sampled more, up to ${lens.highest.toPrecision(3)} times as often as evenly`;
  note.textContent = `The lens from behind: ${share}. Dots: ${lens.draws.length} draws.`;
}
