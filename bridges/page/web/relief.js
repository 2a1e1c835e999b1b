// What the surface is drawn from, pixel by pixel: how deep the skin is dented where, and its shadow on the ground.

const CRISP = 0.7, SOFT = 3; // pixels: how far the colours run, and how far the foam round a dent gives way
const SOFT_SHARE = 0.5;
const SHADOW = 48, SHADOW_SOFT = 1.6; // pixels across, and how far it runs

/** Low-pass with exponential tails, along rows and columns, twice so that it is nearly round. Changes `field`. */
function relax(field, rows, columns, length) {
  const keep = Math.exp(-1 / length);
  const along = (from, step, count) => {
    let last = field[from];
    for (let k = 0, at = from; k < count; k++, at += step) field[at] = last = keep * last + (1 - keep) * field[at];
    for (let k = 0, at = from + step * (count - 1); k < count; k++, at -= step) field[at] = last = keep * last + (1 - keep) * field[at];
  };
  for (let times = 0; times < 2; times++) {
    for (let row = 0; row < rows; row++) along(row * columns, 1, columns);
    for (let column = 0; column < columns; column++) along(column, columns, rows);
  }
  return field;
}

/**
 * Four numbers a pixel: depth and drop, both 1 at `top`, and the depth's slopes along x and y per `cell`, a pixel's side.
 * values: rows from the lowest y.
 */
export function relief(values, rows, columns, top, cell) {
  const share = Float32Array.from(values, (v) => Math.min(1, Math.max(0, v / top)));
  const drop = relax(share.slice(), rows, columns, CRISP), depth = relax(share, rows, columns, SOFT);
  for (let k = 0; k < depth.length; k++) depth[k] = SOFT_SHARE * depth[k] + (1 - SOFT_SHARE) * drop[k];
  const found = new Float32Array(4 * depth.length);
  for (let row = 0, k = 0; row < rows; row++) {
    const below = row > 0 ? columns : 0, above = row < rows - 1 ? columns : 0;
    for (let column = 0; column < columns; column++, k++) {
      const left = column > 0 ? 1 : 0, right = column < columns - 1 ? 1 : 0;
      found[4 * k] = depth[k];
      found[4 * k + 1] = drop[k];
      found[4 * k + 2] = (depth[k + right] - depth[k - left]) / (2 * cell);
      found[4 * k + 3] = (depth[k + above] - depth[k - below]) / (2 * cell);
    }
  }
  return found;
}

/** {pixels, side}: how much light, in bytes four a pixel, a sheet of this outline takes from a square of -width to width. */
export function shadow(outline, width) {
  const field = new Float32Array(SHADOW * SHADOW), at = (k) => (2 * (k + 0.5) / SHADOW - 1) * width;
  const inside = (x, y) => outline.reduce((odd, [x0, y0], k) => {
    const [x1, y1] = outline[(k + 1) % outline.length];
    return y0 > y !== y1 > y && x < x0 + ((y - y0) / (y1 - y0)) * (x1 - x0) ? !odd : odd;
  }, false);
  for (let k = 0; k < field.length; k++) field[k] = inside(at(k % SHADOW), at(Math.floor(k / SHADOW))) ? 255 : 0;
  relax(field, SHADOW, SHADOW, SHADOW_SOFT);
  return { pixels: Uint8Array.from({ length: 4 * field.length }, (_, k) => field[k >> 2]), side: SHADOW };
}
