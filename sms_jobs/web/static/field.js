// The page of a field: maps whose values are fetched, sections, gauges, charts over the states, differences.

const API = "/api/v1/fields";
const SAMPLES = 640;
const MARK = "#ff5a36";
const AGAIN_MS = 1000;

async function asked(address, given) {
  const query = new URLSearchParams(Object.entries(given).filter(([, value]) => value !== null && value !== undefined && value !== ""));
  let answer;
  try { answer = await fetch(`${address}?${query}`, { headers: { Accept: "application/json" } }); } catch { throw new Error("The server does not answer; try again in a moment"); }
  const said = await answer.json().catch(() => ({})); // of a server between, which says it otherwise
  if (!answer.ok) throw new Error(said.error || `The server answered ${answer.status}; try again in a moment`);
  return said;
}

// Values of a file: asked for when they are shown, once; after a failure again, but not with each move of the mouse.
function fetched(about) {
  const waiting = new Map();
  return {
    described(field) {
      if (!waiting.has(field.name)) {
        const { window: w } = about, window = w && [w.top, w.left, w.rows, w.columns].join();
        const asking = asked(`${API}/${about.file}/values`, { name: field.name, part: about.part, window });
        waiting.set(field.name, asking.then((found) => Object.assign(field, found, about.limitsOf?.(field.name))));
        asking.catch(() => setTimeout(() => waiting.delete(field.name), AGAIN_MS));
      }
      return waiting.get(field.name);
    },
    text: (packed) => packed.text,
  };
}

class FieldView extends View {
  get others() { return views.filter((view) => view !== this && view.about.key === this.about.key); }
  get flags() { return this.about.fields.filter((field) => field.flags); }

  // Side by side both have one range of colours, unless another was asked for.
  get shown() {
    const there = this.partner?.fields.named(this.field.name), part = this.part === this.field ? there : there?.sigma;
    if (this.limits || !part?.limits) return super.shown;
    return [Math.min(this.part.limits[0], part.limits[0]), Math.max(this.part.limits[1], part.limits[1])];
  }

  async renew() {
    try {
      const there = this.partner?.fields.named(this.field.name);
      if (there) await this.partner.fields.described(there);
      await super.renew();
      this.section.querySelector(".first")?.remove();
      this.paint();
      this.paintScale(this.shown);
    } catch (error) {
      this.section.querySelector(".first")?.remove();
      this.fields.forget();
      this.read.textContent = `${error.message}.`;
    }
  }

  // Once the map is enlarged its window is fetched in more detail, in the colours of the whole.
  pan(dx, dy) {
    super.pan(dx, dy);
    clearTimeout(this.soon);
    if (!this.partner && this.entire.step > 1) this.soon = setTimeout(() => this.detail(), 250);
  }

  get entire() { return this.kept || this.fields; }

  async detail() {
    const kept = (this.kept ??= this.fields), { about } = kept, { width, height } = this.screen;
    const ends = [this.toPixel(0, 0), this.toPixel(width, height)], sizes = [about.columns, about.rows];
    const [left, top] = ends[0].map((p) => Math.max(0, Math.floor(p)));
    const [columns, rows] = ends[1].map((p, k) => Math.min(sizes[k], Math.ceil(p) + 1) - [left, top][k]);
    const step = Math.max(1, Math.ceil(Math.max(rows, columns) / SAMPLES));
    if (this.space || this.zoom <= 1 || step >= kept.step) return this.take(kept);
    const limits = (name) => {
      const { limits: own, sigma } = kept.named(name);
      return own ? { limits: own, ...(sigma && { shownSigma: sigma.limits }) } : {};
    };
    const inside = { ...about, step, window: { left, top, rows, columns }, limitsOf: limits,
      fields: about.fields.map(({ name, unit, flags, record, array, component, scale }) => ({ name, unit, flags, record, array, component, scale })) };
    const finer = new Fields(inside, fetched(inside));
    await finer.values(inside.fields[this.chosen]);
    const field = inside.fields[this.chosen];
    if (field.sigma && field.shownSigma) field.sigma.limits = field.shownSigma;
    return this.zoom > 1 && !this.space ? this.take(finer) : null;
  }

  take(fields) {
    if (this.fields === fields) return null;
    const at = this.cursor && this.pixelOf(this.cursor);
    this.fields = fields; this.about = fields.about;
    if (at) this.cursor = this.sampleAt(...this.toScreen(...at));
    return this.refresh();
  }

  toggleSpace() {
    if (this.kept) this.take(this.kept);
    super.toggleSpace();
  }

  async status(place) {
    await Promise.all(this.flags.map((field) => this.fields.described(field)));
    return super.status(place);
  }

  point(sample, lead = true) {
    if (lead) for (const other of this.others) if (other.values) other.point(sample, false);
    return super.point(sample);
  }

  pick(sample) {
    this.point(sample);
    picked(this, this.cursor).catch(failed);
  }

  choose(place) {
    const name = this.about.fields[place].name;
    for (const other of this.others) {
      const same = other.about.fields.findIndex((field) => field.name === name);
      if (same >= 0 && same !== other.chosen) View.prototype.choose.call(other, same);
    }
    remember(name);
    return super.choose(place);
  }

  paintOver(context) {
    for (const line of marks) {
      const ends = line.map((pixel) => this.toScreen(...pixel));
      for (const [colour, wide] of [["#ffffff", 4], [MARK, 2]]) {
        context.strokeStyle = colour; context.lineWidth = wide; context.beginPath();
        context.moveTo(...ends[0]); for (const end of ends.slice(1)) context.lineTo(...end);
        context.stroke();
        for (const [x, y] of ends) context.strokeRect(x - 3, y - 3, 6, 6);
      }
    }
  }
}

// The chosen quantity goes along to other states and views.
function remember(name) {
  history.replaceState(null, "", `#${encodeURIComponent(name)}`);
  for (const link of document.querySelectorAll("a[data-keep]")) link.hash = encodeURIComponent(name);
}

// What went along; nothing of a link that was cut off.
function remembered() {
  try { return decodeURIComponent(location.hash.slice(1)); } catch { return ""; }
}

// What the first result says more than the second at the same pixels: their values subtracted, their variances added.
class DifferenceFields {
  constructor(first, second, about) {
    Object.assign(this, { first, second, about });
    for (const key of ["step", "half", "left", "top", "rows", "columns"]) this[key] = first.fields[key];
    this.waiting = new Map();
  }

  named(name) { return this.about.fields.find((field) => field.name === name); }
  vectors(names) { return this.first.fields.vectors(names); }
  forget() { for (const one of [this, this.first.fields, this.second.fields]) one.waiting.clear(); }
  async both(field, part) {
    const of = (view) => view.fields[part](view.fields.named(field.name));
    return Promise.all([of(this.first), of(this.second)]);
  }

  async described(field) {
    const values = await this.values(field), sigma = await this.sigma(field);
    const most = Math.max(...limitsOf(values).map(Math.abs));
    field.limits = [-most, most];
    if (sigma) field.sigma = { limits: limitsOf(sigma) };
  }

  values(field) {
    return this.once(field, "", async () => {
      const [a, b] = await this.both(field, "values");
      return a.map((value, i) => value - b[i]);
    });
  }

  sigma(field) {
    return this.once(field, "sigma", async () => {
      const [a, b] = await this.both(field, "sigma");
      return a && b ? a.map((sigma, i) => Math.hypot(sigma, b[i])) : null;
    });
  }

  once(field, part, make) {
    const id = `${field.name} ${part}`;
    if (!this.waiting.has(id)) this.waiting.set(id, make());
    return this.waiting.get(id);
  }
}

// The middle 98 % of what is known, as on the server.
function limitsOf(values) {
  const known = values.filter((value) => value === value).sort();
  if (!known.length) return [0, 1];
  const at = (part) => known[Math.min(known.length - 1, Math.round(part * (known.length - 1)))];
  const [low, high] = [at(0.01), at(0.99)];
  return high > low ? [low, high] : [low - 1e-2 * Math.abs(low) - 1e-12, high + 1e-2 * Math.abs(high) + 1e-12];
}

const element = (id) => document.getElementById(id);
const chosenTool = () => document.querySelector("input[name=tool]:checked").value;
let marks = [], begun = null, asking = 0;

function draw(lines) {
  marks = lines;
  for (const view of views) view.paint();
}

function tell(words) { element("told").textContent = words; }

// Runs something that takes a while; what was asked for later wins.
async function attempt(work) {
  const mine = ++asking, late = () => mine !== asking;
  try { await work(late); } catch (error) { if (!late()) failed(error); }
}

// Says why something was not read, without what was read before; what could not be fetched may be there later.
function failed(error) {
  tell(`${error.message}.`);
  for (const old of ["chart", "table"]) element(old).replaceChildren();
  for (const view of views) view.fields.forget();
}

async function picked(view, sample) {
  const pixel = view.pixelOf(sample), tool = chosenTool();
  if (tool === "point") { begun = null; draw([]); return attempt((late) => overStates(view, pixel, late)); }
  const place = await placeOf(view, sample, tool !== "section");
  if (!place) { tell("The surface was not measured there; choose another place."); return null; }
  if (tool === "place") { gaugeText(`x=${place.words[0]} y=${place.words[1]} length=${element("gauge-length").value}${place.unit}`); return readGauge(view); }
  if (!begun) { begun = { pixel, place }; draw([[pixel]]); tell("Choose the second point."); return null; }
  const first = begun;
  begun = null;
  if (tool === "section") {
    element("from").value = first.place.words.join(", "); element("to").value = place.words.join(", ");
    return drawSection(view);
  }
  const [a, b] = [first.place.at, place.at], up = view.about.position ? 1 : -1;
  const length = Math.hypot(b[0] - a[0], b[1] - a[1]), angle = Math.atan2(up * (b[1] - a[1]), b[0] - a[0]) * 180 / Math.PI;
  const [x, y] = [0, 1].map((k) => ((a[k] + b[k]) / 2).toFixed(3));
  gaugeText(`x=${x}${place.unit} y=${y}${place.unit} length=${length.toFixed(3)}${place.unit} angle=${angle.toFixed(2)}`);
  return readGauge(view);
}

function gaugeText(words) { element("gauge-text").value = `G1 ${words}`; }

// Where a sample lies: in mm, in the frame of gauges or of sections; of a camera alone its column and row.
async function placeOf(view, sample, ofGauge) {
  const pixel = view.pixelOf(sample);
  if (!view.about.position) return { at: pixel, words: ofGauge ? pixel.map((p) => `${p}px`) : pixel.map(String), unit: ofGauge ? "px" : "" };
  const position = await view.fields.vectors(view.about.position), i = sample.row * view.fields.columns + sample.column;
  const world = position.map((axis) => axis[i]);
  if (world.some((v) => v !== v)) return null;
  const at = ofGauge ? applied(view.about.turn, world.map((v, k) => v - view.about.shift[k])) : world;
  return { at, words: at.slice(0, 2).map((v) => v.toFixed(3)), unit: "" };
}

// The pixel that lies next to a place, to draw it there.
async function pixelAt(view, x, y, ofGauge) {
  if (!view.about.position) return [x, y];
  const { entire } = view, [X, Y, Z] = await entire.vectors(view.about.position), { turn, shift } = view.about;
  let best = -1, least = Infinity;
  for (let i = 0; i < X.length; i++) {
    if (X[i] !== X[i]) continue;
    const [u, v] = ofGauge ? applied(turn, [X[i] - shift[0], Y[i] - shift[1], Z[i] - shift[2]]) : [X[i], Y[i]];
    const away = (u - x) ** 2 + (v - y) ** 2;
    if (away < least) { least = away; best = i; }
  }
  return [best % entire.columns, Math.floor(best / entire.columns)].map((k) => k * entire.step + entire.half);
}

// A chart of something over the states of the view, drawn further with every state that is read.
async function chartOverStates(view, title, unit, read, late) {
  const states = view.about.states.length ? view.about.states : [{ file: view.about.file, state: view.about.state, load: null }];
  const loads = states.every((one) => one.load !== null), points = [], rows = [];
  const axis = loads ? { label: "load [N]", names: false } : null;
  for (const [place, one] of states.entries()) {
    let found = null;
    try { found = await read(one); } catch (error) {
      if (one.file === view.about.file) throw error;
      rows.push([one.state, error.message]);
      continue;
    }
    if (late()) return rows;
    rows.push([one.state, found.value === null ? `no value${found.why ? ` (${found.why})` : ""}` : `${written(found.value, found.sigma)} ± ${written(found.sigma ?? NaN, found.sigma)} ${unit}`]);
    if (found.value !== null) points.push({ x: loads ? one.load : place, value: found.value, sigma: found.sigma || 0, state: one.state });
    if (points.length > 1) element("chart").replaceChildren(pointChart([...points].sort((a, b) => a.x - b.x), title, unit, axis));
    showRows(["state", title], rows);
  }
  if (points.length < 2) element("chart").replaceChildren();
  return rows;
}

function showRows(heads, rows) {
  element("table").replaceChildren(made("table", {}, made("thead", {}, made("tr", {}, ...heads.map((h) => made("th", { scope: "col" }, h)))),
    made("tbody", {}, ...rows.map((row) => made("tr", {}, ...row.map((cell) => made("td", {}, String(cell))))))));
}

async function overStates(view, [column, row], late) {
  const field = view.field, { part } = view.about, title = `${field.name} at x ${column}, y ${row} px`;
  if (view.fields instanceof DifferenceFields || field.flags) return;
  const own = await asked(`${API}/${view.about.file}/at`, { name: field.name, part, column, row });
  if (late()) return;
  tell(`${title}: ${own.value === null ? `no value (${own.reason})` : written(own.value, own.sigma)}${own.sigma === null ? "" : ` ± ${written(own.sigma, own.sigma)}`} ${own.unit}, as archived.`);
  await chartOverStates(view, title, field.unit, async ({ file }) => {
    const found = await asked(`${API}/${file}/at`, { name: field.name, part, column, row });
    return { value: found.value, sigma: found.sigma, why: found.reason };
  }, late);
}

function numberOf(words, key) {
  const found = new RegExp(`\\b${key}=(-?[0-9.eE+-]+)`).exec(words);
  return found ? Number(found[1]) : 0;
}

function readGauge(view) {
  const words = element("gauge-text").value;
  return attempt(async (late) => {
    tell("Reading the gauge…");
    const half = numberOf(words, "length") / 2, angle = (numberOf(words, "angle") * Math.PI) / 180;
    const up = view.about.position ? 1 : -1, x = numberOf(words, "x"), y = numberOf(words, "y");
    const ends = await Promise.all([-1, 1].map((s) => pixelAt(view, x + s * half * Math.cos(angle), y + up * s * half * Math.sin(angle), true)));
    draw([ends]);
    const read = ({ file }) => asked(`${API}/${file}/gauge`, { gauge: words, part: view.about.part });
    const own = await read(view.about);
    if (late()) return;
    tell(own.strain === null ? `${words} reads nothing: it lies off the specimen, or fewer than twelve valid points lie under it.`
      : `${words}: ${written(1e6 * own.strain, 1e6 * own.sigma)} ± ${written(1e6 * own.sigma, 1e6 * own.sigma)} µε, from ${own.pixels} pixels of ${own.view}. “sms job submit gauges -c ${view.about.campaign} --gauge "${words}"” keeps it.`);
    await chartOverStates(view, `gauge ${words.split(" ")[0]}`, "µε", async (one) => {
      const found = one.file === view.about.file ? own : await read(one);
      return { value: found.strain === null ? null : 1e6 * found.strain, sigma: found.sigma === null ? null : 1e6 * found.sigma };
    }, late);
  });
}

function drawSection(view) {
  const [[x0, y0], [x1, y1]] = ["from", "to"].map((id) => element(id).value.split(",").map(Number));
  return attempt(async (late) => {
    const { field } = view;
    if (!field.array || !field.record) throw new Error(`A section has components that are archived; choose one of them instead of ${field.name}`);
    draw([await Promise.all([pixelAt(view, x0, y0, false), pixelAt(view, x1, y1, false)])]);
    const width = Number(element("width").value), step = width / 2;
    const found = await asked(`/api/v1/data/${view.about.file}/section`, { x0, y0, x1, y1, record: field.record, field: field.array, width, step });
    if (late()) return;
    const place = (found.unit === "mm" ? 4 : 3) + field.component;
    const points = found.rows.map((row, i) => ({ at: row[0], value: row[place] === null ? null : row[place] * field.scale,
      scatter: (found.scatter[field.component][i] ?? 0) * field.scale, pixels: row.at(-1) }));
    element("chart").replaceChildren(lineChart(points, field, found.unit));
    const known = points.filter((p) => p.value !== null);
    tell(`${field.name} from ${element("from").value} to ${element("to").value}: ${known.length} of ${points.length} pieces have a value; the band is one standard deviation of the pixels in the strip.`);
    showRows([`distance [${found.unit}]`, `${field.name} [${field.unit}]`, "scatter", "pixels"],
      points.map((p) => [p.at, p.value === null ? "no value" : written(p.value, p.scatter), p.value === null ? "" : written(p.scatter, p.scatter), p.pixels]));
  });
}

// A quantity over the distance, with a band.
function lineChart(points, field, unit) {
  const width = 560, height = 260, left = 66, right = width - 14, top = 12, bottom = height - 46;
  const known = points.filter((p) => p.value !== null), ends = known.flatMap((p) => [p.value - p.scatter, p.value + p.scatter]);
  const title = `${field.name} along the section`, svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": title });
  if (!known.length) return svg;
  const low = Math.min(...ends), high = Math.max(...ends), room = 0.05 * (high - low) || 1;
  const [y0, y1] = [low - room, high + room], [x0, x1] = [0, points.at(-1).at];
  const x = (v) => left + ((v - x0) / (x1 - x0)) * (right - left), y = (v) => bottom - ((v - y0) / (y1 - y0)) * (bottom - top);
  for (const value of ticks(y0, y1, 6)) svg.append(drawn("path", { class: "grid", d: `M${left} ${y(value)}H${right}` }),
    drawn("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, String(Number(value.toPrecision(6)))));
  for (const value of ticks(x0, x1, 6)) svg.append(drawn("text", { x: x(value), y: bottom + 17, "text-anchor": "middle" }, String(Number(value.toPrecision(6)))));
  svg.append(drawn("path", { class: "axis", d: `M${left} ${top}V${bottom}H${right}` }),
    drawn("text", { x: (left + right) / 2, y: bottom + 37, "text-anchor": "middle" }, `distance [${unit}]`),
    drawn("text", { transform: `translate(14 ${(top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, field.unit ? `[${field.unit}]` : ""));
  // A gap parts the line.
  const runs = [[]];
  for (const p of points) if (p.value === null) runs.push([]); else runs.at(-1).push(p);
  for (const run of runs.filter((r) => r.length)) {
    const upper = run.map((p) => `${x(p.at)} ${y(p.value + p.scatter)}`), lower = run.map((p) => `${x(p.at)} ${y(p.value - p.scatter)}`).reverse();
    svg.append(drawn("path", { class: "band", d: `M${[...upper, ...lower].join("L")}Z` }),
      drawn("path", { class: "line t0", d: `M${run.map((p) => `${x(p.at)} ${y(p.value)}`).join("L")}` }));
  }
  return svg;
}

// Two results side by side: their maps have one range, and a third shows the one minus the other.
async function compare(first, second) {
  const differs = element("differs");
  first.partner = second; second.partner = first;
  if (first.about.key === second.about.key && first.about.rows === second.about.rows && first.about.columns === second.about.columns) {
    const section = element("difference"), named = (f) => second.about.fields.some((g) => g.name === f.name);
    const about = { ...first.about, id: "difference", title: section.getAttribute("aria-label"),
      fields: first.about.fields.filter((f) => !f.flags && named(f)).map((f) => ({ name: f.name, unit: f.unit })), movement: null };
    section.hidden = false;
    section.append(made("script", { type: "application/json", class: "about" }, JSON.stringify(about)));
    const view = new FieldView(section, null);
    view.fields = new DifferenceFields(first, second, view.about);
    view.colours = "bluered";
    views.push(view);
    view.chosen = Math.max(0, about.fields.findIndex((f) => f.name === first.field.name));
  } else {
    differs.append(made("p", { class: "notes" }, "They are not over the same pixels: only displacements on a surface are subtracted."));
  }
  if (![first, second].every((view) => ["merge", "combine"].includes(view.about.source))) return;
  try {
    const found = await asked(`/api/v1/data/${first.about.file}/compare`, { with: second.about.file });
    const rows = Object.entries(found).filter(([name]) => !["schema", "file", "other"].includes(name))
      .map(([name, value]) => made("tr", {}, made("th", { scope: "row" }, name.replace(/_mm/g, " [mm]").replace(/_/g, " ")), made("td", { class: "number" }, written(value))));
    differs.append(made("h3", {}, "Displacements on the surface"), made("table", { class: "narrow" }, made("tbody", {}, ...rows)));
  } catch (error) { differs.append(made("p", { class: "problem" }, `${error.message}.`)); }
}

// The first pictures come before anything else is asked for.
function glanced() {
  const pictures = [...document.querySelectorAll(".first img")].filter((picture) => !picture.complete);
  return Promise.all(pictures.map((picture) => new Promise((done) => {
    for (const end of ["load", "error"]) picture.addEventListener(end, done, { once: true });
  })));
}

async function begin() {
  const sections = [...document.querySelectorAll("#maps section.view")].filter((section) => section.querySelector("script.about"));
  for (const section of sections) {
    const about = JSON.parse(section.querySelector("script.about").textContent), view = new FieldView(section, fetched(about));
    const wanted = view.about.fields.findIndex((field) => field.name === remembered());
    if (wanted > 0) { view.chosen = wanted; view.section.querySelector(".first img").src += `&name=${encodeURIComponent(view.field.name)}`; }
    views.push(view);
  }
  const first = views[0];
  if (location.hash) remember(first.field.name);
  element("section").addEventListener("submit", (event) => { event.preventDefault(); drawSection(first); });
  element("gauge").addEventListener("submit", (event) => { event.preventDefault(); readGauge(first); });
  for (const tool of document.querySelectorAll("input[name=tool]")) tool.addEventListener("change", () => { begun = null; draw([]); });
  const repaint = () => { for (const view of views) if (view.values) view.refresh(); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  new MutationObserver(repaint).observe(document.documentElement, { attributeFilter: ["data-theme"] });
  await glanced();
  if (views.length > 1) compare(views[0], views[1]);
  for (const view of views) view.refresh();
}

begin();
