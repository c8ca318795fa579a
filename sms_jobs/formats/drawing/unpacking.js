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

// Whole numbers from how far each is from what its neighbours let expect, modulo `mask`; in place.
function summed(numbers, rows, columns, mask) {
  for (let row = 0, place = 0; row < rows; row++) for (let column = 0; column < columns; column++, place++) {
    const left = column ? numbers[place - 1] : row ? numbers[place - columns] : 0;
    const above = row ? numbers[place - columns] : left;
    const sum = left + above - (row && column ? numbers[place - columns - 1] : left);
    const expected = Math.min(Math.max(sum, Math.min(left, above)), Math.max(left, above));
    const away = numbers[place];
    numbers[place] = (expected + (away & 1 ? ~(away >> 1) : away >> 1)) & mask;
  }
  return numbers;
}

// Values of a field over the samples, NaN for none.
async function unpacked(packed, text, rows, columns) {
  const bytes = await inflated(text), count = rows * columns, numbers = new Uint16Array(count);
  for (let i = 0; i < count; i++) numbers[i] = (bytes[i] << 8) + bytes[count + i];
  return Float64Array.from(summed(numbers, rows, columns, 0xffff),
    (number) => (number ? packed.low + (number - 1) * packed.step : NaN));
}

// Standard deviations over the samples, NaN for none.
async function unpackedSigma(packed, text, rows, columns) {
  return Float64Array.from(summed(await inflated(text), rows, columns, 0xff),
    (number) => (number ? packed.low * Math.exp((number - 1) * packed.step) : NaN));
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

  values(field) {
    return this.once(field, "", async () => {
      const values = await unpacked(field, this.source.text(field), this.rows, this.columns);
      // Positions that several states share are known where this field is.
      const seen = field.within && await this.values(this.named(field.within));
      return seen ? values.map((value, i) => (seen[i] === seen[i] ? value : NaN)) : values;
    });
  }

  sigma(field) {
    return this.once(field, "sigma", () => field.sigma &&
      unpackedSigma(field.sigma, this.source.text(field.sigma), this.rows, this.columns));
  }

  vectors(names) {
    if (!names) return Promise.resolve(null);
    return Promise.all(names.map((name) => this.values(this.named(name))));
  }

  // Lets go of all that was unpacked.
  forget() { this.waiting.clear(); }

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
