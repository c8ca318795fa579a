// A point of the surface over the states: a chart of the chosen field with its standard deviations.

const LARGEST_LABELS = 12;
const SVG = "http://www.w3.org/2000/svg";

// Round numbers from low to high: 1, 2 or 5 times a power of ten apart.
function ticks(low, high, count) {
  if (!(high > low)) return [low];
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((f) => f * power).find((s) => s >= rough * (1 - 1e-9));
  const found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) found.push(n * step);
  return found;
}

function drawn(tag, attributes, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

function chosenAxis() {
  const block = document.querySelector("script.axes");
  if (!block) return null;
  const select = document.querySelector(".axis-choice");
  return JSON.parse(block.textContent)[select ? Number(select.value) : 0];
}

async function followPoint(view, sample) {
  const name = view.field.name, alike = views.filter((v) => v.about.key === view.about.key && v.fields.named(name));
  const axis = chosenAxis(), points = [];
  view.path.replaceChildren(made("p", { class: "notes" }, `Reading ${alike.length} maps …`));
  for (const [place, other] of alike.entries()) {
    const field = other.fields.named(name), at = sample.row * other.fields.columns + sample.column;
    const value = (await other.fields.values(field))[at], sigma = ((await other.fields.sigma(field)) || [])[at];
    if (!other.values) other.fields.forget();
    const x = axis ? axis.places[other.about.state] : place;
    if (value === value && x !== undefined) points.push({ x, value, sigma: sigma === sigma ? sigma ?? 0 : 0, state: other.about.state });
  }
  const [column, row] = view.pixelOf(sample), title = `${name} at x ${column}, y ${row} px of ${view.about.key}`;
  if (view.field.categories || points.length < 2) {
    view.path.replaceChildren();
    return;
  }
  points.sort((a, b) => a.x - b.x);
  const close = made("button", { type: "button", onclick: () => view.path.replaceChildren() }, "close the chart");
  view.path.replaceChildren(
    made("div", { class: "chart" }, pointChart(points, title, view.field.unit, axis)),
    made("p", { class: "notes" }, `${title}, over the states whose maps are on this page; bars are one standard deviation.`),
    made("div", { class: "controls" }, close));
}

function pointChart(points, title, unit, axis) {
  const width = 560, height = 260, left = 66, right = width - 14, top = 12, bottom = height - 46;
  const span = (values) => {
    const low = Math.min(...values), high = Math.max(...values), room = 0.05 * (high - low) || 0.5 * Math.abs(high) || 1;
    return [low - room, high + room];
  };
  const [x0, x1] = span(points.map((p) => p.x));
  const [y0, y1] = span(points.flatMap((p) => [p.value - p.sigma, p.value + p.sigma]));
  const x = (v) => left + ((v - x0) / (x1 - x0)) * (right - left), y = (v) => bottom - ((v - y0) / (y1 - y0)) * (bottom - top);
  const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": title });
  const text = (words, attributes) => svg.append(drawn("text", attributes, words));
  for (const value of ticks(y0, y1, 6)) {
    svg.append(drawn("path", { class: "grid", d: `M${left} ${y(value)}H${right}` }));
    text(String(Number(value.toPrecision(6))), { x: left - 6, y: y(value) + 4, "text-anchor": "end" });
  }
  const named = !axis || axis.names;
  const every = Math.ceil(points.length / LARGEST_LABELS);
  const marks = named ? points.filter((_, place) => place % every === 0).map((p) => [p.x, p.state]) : ticks(x0, x1, 6).map((v) => [v, String(Number(v.toPrecision(6)))]);
  for (const [value, label] of marks) text(label, { x: x(value), y: bottom + 17, "text-anchor": "middle" });
  svg.append(drawn("path", { class: "axis", d: `M${left} ${top}V${bottom}H${right}` }));
  text(axis ? axis.label : "state", { x: (left + right) / 2, y: bottom + 37, "text-anchor": "middle" });
  text(unit ? `[${unit}]` : "", { transform: `translate(14 ${(top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" });
  svg.append(drawn("path", { class: "line t0", d: "M" + points.map((p) => `${x(p.x)} ${y(p.value)}`).join("L") }));
  for (const p of points) {
    const words = `${p.state}: ${written(p.value, p.sigma)}${p.sigma ? ` ± ${written(p.sigma, p.sigma)}` : ""} ${unit}`;
    const low = y(p.value - p.sigma), high = y(p.value + p.sigma);
    svg.append(drawn("g", {}, drawn("title", {}, words),
      drawn("path", { class: "bar t0", d: `M${x(p.x)} ${low}V${high}M${x(p.x) - 4} ${low}h8M${x(p.x) - 4} ${high}h8` }),
      drawn("circle", { class: "f0", cx: x(p.x), cy: y(p.value), r: 4 })));
  }
  return svg;
}
