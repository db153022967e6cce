// The per-window columns of a session, growing at the end, each with a min/max pyramid so that any stretch
// of 100,000 windows is drawn from a few dozen numbers.

const FAN = 16;

/** Least and greatest value of any range in O(log n). NaN is skipped: comparisons with it are false. */
export class Pyramid {
  #values;
  #levels = []; // [{least, greatest}] of FAN, FAN², … values

  constructor(values, count) {
    this.update(values, count, 0);
  }

  /** Takes `count` values, of which those from `start` on are new. */
  update(values, count, start) {
    this.#values = values;
    let below = null;
    let length = count;
    for (let level = 0; length > FAN; level++) {
      const blocks = Math.ceil(length / FAN);
      const old = this.#levels[level];
      const least = grown(old?.least, blocks);
      const greatest = grown(old?.greatest, blocks);
      const first = old ? Math.floor(start / FAN ** (level + 1)) : 0;
      for (let block = first; block < blocks; block++) {
        let low = Infinity;
        let high = -Infinity;
        const end = Math.min(length, (block + 1) * FAN);
        for (let i = block * FAN; i < end; i++) {
          const a = below ? below.least[i] : values[i];
          const b = below ? below.greatest[i] : values[i];
          if (a < low) low = a;
          if (b > high) high = b;
        }
        least[block] = low;
        greatest[block] = high;
      }
      below = this.#levels[level] = { least, greatest };
      length = blocks;
    }
  }

  /** [least, greatest] of the values start to end (end left out); [Infinity, -Infinity] where all are NaN. */
  range(start, end) {
    let low = Infinity;
    let high = -Infinity;
    const visit = (level, i) => {
      const a = level < 0 ? this.#values[i] : this.#levels[level].least[i];
      const b = level < 0 ? this.#values[i] : this.#levels[level].greatest[i];
      if (a < low) low = a;
      if (b > high) high = b;
    };
    for (let level = -1; start < end; level++) {
      if (level + 1 >= this.#levels.length) {
        while (start < end) visit(level, start++);
        break;
      }
      while (start < end && start % FAN) visit(level, start++);
      while (start < end && end % FAN) visit(level, --end);
      start /= FAN;
      end /= FAN;
    }
    return [low, high];
  }
}

function grown(old, length) {
  if (old && old.length >= length) return old;
  const bigger = new Float64Array(Math.max(64, 2 * length));
  if (old) bigger.set(old);
  return bigger;
}

/** The columns by name, as they are known so far. */
export class Columns {
  count = 0;
  #data = {};
  #pyramids = {};
  #badness;
  #extra = new Set(); // names of columns that came by `put`

  /** `badness[status]` orders the states, so that a stretch is drawn as its worst one: column `badness`. */
  constructor(badness) {
    this.#badness = Uint8Array.from(badness);
  }

  /** Adds an answer of `api.columns`; windows that are known already are replaced. */
  append({ start, count, columns }) {
    if (start > this.count) throw new RangeError(`columns: expected start at most ${this.count}, got ${start}`);
    const end = start + count;
    const badness = columns.status.map((number) => this.#badness[number] ?? 0);
    for (const [name, values] of Object.entries({ ...columns, badness })) {
      let data = this.#data[name];
      if (!data || data.length < end) {
        const bigger = new values.constructor(Math.max(256, Math.ceil(end * 1.5)));
        if (data) bigger.set(data.subarray(0, this.count));
        data = this.#data[name] = bigger;
      }
      data.set(values, start);
      const known = this.#pyramids[name];
      if (known) known.update(data, end, start);
      else this.#pyramids[name] = new Pyramid(data, end);
    }
    const before = this.count;
    this.count = Math.max(this.count, end);
    for (const name of this.#extra) {
      this.#grow(name);
      this.#pyramids[name].update(this.#data[name], this.count, Math.min(before, this.count));
    }
  }

  /** Adds columns that are fetched by themselves, from window `start` on; unknown values are NaN. */
  put({ start, count, columns }) {
    for (const [name, values] of Object.entries(columns)) {
      if (!this.#extra.has(name)) {
        this.#extra.add(name);
        this.#data[name] = new Float32Array(Math.max(256, Math.ceil(this.count * 1.5))).fill(NaN);
      }
      this.#grow(name);
      this.#data[name].set(values.subarray(0, Math.max(0, this.count - start)), start);
      const known = this.#pyramids[name];
      if (known) known.update(this.#data[name], this.count, start);
      else this.#pyramids[name] = new Pyramid(this.#data[name], this.count);
    }
    return start + count;
  }

  /** Makes room for as many values as there are windows. */
  #grow(name) {
    const data = this.#data[name];
    if (data.length >= this.count) return;
    const bigger = new Float32Array(Math.ceil(this.count * 1.5)).fill(NaN);
    bigger.set(data);
    this.#data[name] = bigger;
  }

  /** The values of a column (longer than `count`: there is room to grow), or undefined. */
  get(name) {
    return this.#data[name];
  }

  pyramid(name) {
    return this.#pyramids[name];
  }

  has(name) {
    const pyramid = this.#pyramids[name];
    return pyramid !== undefined && pyramid.range(0, this.count)[0] !== Infinity;
  }

  /** The window after the last one, of the newest `most`, in which a column is a number. */
  knownTo(name, most) {
    const values = this.#data[name];
    for (let i = this.count - 1; values && i >= Math.max(0, this.count - most); i--) if (Number.isFinite(values[i])) return i + 1;
    return Math.max(0, this.count - most);
  }

  /** The first window that starts at `seconds` or later. */
  firstAt(seconds) {
    const t = this.#data.t_s;
    let low = 0;
    let high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (t[middle] < seconds) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** The window that holds a time, clamped to what is known. */
  windowAt(seconds) {
    const next = this.firstAt(seconds);
    const holds = next < this.count && this.#data.t_s[next] === seconds ? next : next - 1;
    return Math.max(0, Math.min(this.count - 1, holds));
  }

  /** A range that holds nearly all values: outliers above the 99.5th percentile are clipped. */
  spread(name) {
    const values = this.#data[name];
    if (!values || !this.count) return [0, 1];
    const stride = Math.max(1, Math.floor(this.count / 4000));
    const sample = [];
    for (let i = 0; i < this.count; i += stride) if (Number.isFinite(values[i])) sample.push(values[i]);
    if (!sample.length) return [0, 1];
    sample.sort((a, b) => a - b);
    return [sample[Math.floor(0.005 * (sample.length - 1))], sample[Math.ceil(0.995 * (sample.length - 1))]];
  }
}
