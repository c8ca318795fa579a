// Packed fields become numbers again; see packing.py.

const views = [];

// Where the values of a page come from that holds them itself. A source says what is known of a field before it
// is drawn, and gives the text that `packed` stands for.
const EMBEDDED = {
  described: (field) => Promise.resolve(field),
  text: (packed) => document.getElementById(packed.data).textContent,
};

async function inflated(text) {
  const letters = atob(text);
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Values of a field over the samples, NaN for none.
async function unpacked(packed, text, rows, columns) {
  const bytes = await inflated(text);
  const count = rows * columns;
  const values = new Float64Array(count);
  for (let row = 0, place = 0; row < rows; row++) {
    let number = 0;
    for (let column = 0; column < columns; column++, place++) {
      number = (number + (bytes[place] << 8) + bytes[count + place]) & 0xffff;
      values[place] = number ? packed.low + (number - 1) * packed.step : NaN;
    }
  }
  return values;
}

// Standard deviations over the samples, NaN for none.
async function unpackedSigma(packed, text, rows, columns) {
  const bytes = await inflated(text);
  const values = new Float64Array(rows * columns);
  for (let row = 0, place = 0; row < rows; row++) {
    let number = 0;
    for (let column = 0; column < columns; column++, place++) {
      number = (number + bytes[place]) & 0xff;
      values[place] = number ? packed.low * Math.exp((number - 1) * packed.step) : NaN;
    }
  }
  return values;
}

// The fields of one view, unpacked when they are asked for.
class Fields {
  constructor(about, source) {
    this.about = about;
    this.source = source;
    this.step = about.step;
    this.half = Math.floor(about.step / 2);
    // Of a window of the image, where there is one.
    const { left, top, rows, columns } = about.window || { left: 0, top: 0, rows: about.rows, columns: about.columns };
    this.left = left; this.top = top;
    this.rows = Math.ceil((rows - this.half) / about.step);
    this.columns = Math.ceil((columns - this.half) / about.step);
    this.waiting = new Map();
  }

  named(name) { return this.about.fields.find((field) => field.name === name); }

  described(field) { return this.source.described(field); }

  values(field) { return this.once(field, "", () => unpacked(field, this.source.text(field), this.rows, this.columns)); }

  sigma(field) {
    return this.once(field, "sigma", () => field.sigma &&
      unpackedSigma(field.sigma, this.source.text(field.sigma), this.rows, this.columns));
  }

  vectors(names) {
    if (!names) return Promise.resolve(null);
    return Promise.all(names.map((name) => this.values(this.named(name))));
  }

  once(field, part, make) {
    const id = `${field.name} ${part}`;
    if (!this.waiting.has(id)) this.waiting.set(id, this.described(field).then(make));
    return this.waiting.get(id);
  }
}

// Writes a number with as many digits as it is worth: two of its standard deviation, else five of itself.
function written(value, sigma) {
  if (!Number.isFinite(value)) return "no value";
  const worth = Number.isFinite(sigma) && sigma > 0 ? 1 - Math.floor(Math.log10(sigma)) : null;
  if (worth === null) {
    const size = Math.abs(value);
    return size && (size < 1e-4 || size >= 1e7) ? value.toExponential(4) : String(Number(value.toPrecision(5)));
  }
  return value.toFixed(Math.min(Math.max(worth, 0), 12));
}

function made(tag, attributes, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== false && value !== null) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}
