// Data of the traces: what trace_coding.py wrote, and coarser levels of it made here by merging buckets in pairs.

class Tier {
  // Values in the unit of their joint, NaN where there is a hole; times in s from the recording's first sample; quanta of every trace likewise.
  constructor(layout, bytes, startS, quanta) {
    const n = layout.count;
    const row = (k, read) => {
      for (let i = 0, at = 4 * n * k; i < n; i++, at++)
        read(i, (bytes[at] | (bytes[at + n] << 8) | (bytes[at + 2 * n] << 16) | (bytes[at + 3 * n] << 24)) >>> 0);
    };
    const times = (k, into) => {
      row(k, (i, v) => (into[i] = v * 1e-3));
      row(k + 1, (i, v) => (into[i] += v * 1e-9));
    };
    const level = { begins: new Uint8Array(n), first: new Float64Array(n), last: new Float64Array(n) };
    row(0, (i, v) => (level.begins[i] = v));
    times(1, level.first);
    times(3, level.last);
    for (let i = 0, t = startS; i < n; i++) {
      t += level.first[i];
      level.first[i] = t;
      level.last[i] += t;
    }
    this.size = layout.size;
    this.levels = [level];
    this.values = new Map();
    this.read = (index) => {
      const low = new Float32Array(n), high = new Float32Array(n), whole = new Int32Array(n), at = 5 + 2 * layout.rows[index];
      let last = 0;
      row(at, (i, v) => (whole[i] = last += (v >>> 1) ^ -(v & 1)));
      row(at + 1, (i, v) => {
        low[i] = v ? whole[i] * quanta[index] : NaN;
        high[i] = v ? (whole[i] + v - 1) * quanta[index] : NaN;
      });
      return [low, high];
    };
  }

  // Times of level k: each of its buckets is two of the level below, one where a run ends.
  level(k) {
    while (this.levels.length <= k) {
      const below = this.levels[this.levels.length - 1], starts = [];
      for (let i = 0, place = 0; i < below.begins.length; i++, place++) {
        if (below.begins[i]) place = 0;
        if (place % 2 === 0) starts.push(i);
      }
      const end = (j) => (j + 1 < starts.length ? starts[j + 1] : below.begins.length) - 1;
      this.levels.push({
        starts,
        begins: Uint8Array.from(starts, (i) => below.begins[i]),
        first: Float64Array.from(starts, (i) => below.first[i]),
        last: Float64Array.from(starts, (_, j) => below.last[end(j)]),
      });
    }
    return this.levels[k];
  }

  // [low, high] of a trace at level k; read and merged when first asked for.
  trace(index, k) {
    if (!this.values.has(index)) this.values.set(index, [this.read(index)]);
    const kept = this.values.get(index);
    while (kept.length <= k) {
      const [low, high] = kept[kept.length - 1], { starts } = this.level(kept.length);
      const next = [new Float32Array(starts.length), new Float32Array(starts.length)];
      for (let j = 0; j < starts.length; j++) {
        const a = starts[j], b = (j + 1 < starts.length ? starts[j + 1] : low.length) - 1;
        next[0][j] = Math.min(low[a], low[b]);
        next[1][j] = Math.max(high[a], high[b]);
      }
      kept.push(next);
    }
    return kept[k];
  }

  // Rows [from, to) of level k whose samples lie between two times, and one more on either side.
  range(k, fromS, toS) {
    const { first, last } = this.level(k);
    const from = lowerBound(last, fromS), to = lowerBound(first, toS);
    return [Math.max(from - 1, 0), Math.min(to + 1, first.length)];
  }

  // The finest level that has at most so many rows between two times.
  levelFor(fromS, toS, most) {
    for (let k = 0; ; k++) {
      const [from, to] = this.range(k, fromS, toS);
      if (to - from <= most || k > 30) return k;
    }
  }
}

function lowerBound(sorted, value) {
  let low = 0, high = sorted.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] < value) low = middle + 1;
    else high = middle;
  }
  return low;
}

async function readTier(layout, text, startS, quanta) {
  const characters = atob(text), packed = new Uint8Array(characters.length);
  for (let i = 0; i < packed.length; i++) packed[i] = characters.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Tier(layout, new Uint8Array(await new Response(stream).arrayBuffer()), startS, quanta);
}
