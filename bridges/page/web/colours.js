// The colours of the conductivity drop, the same as in `skin top`.

const RAMP = [[16, 18, 32], [56, 24, 96], [150, 30, 90], [230, 90, 40], [255, 200, 60], [255, 255, 220]];
const STEPS = 512;
export const FULL_SCALE = 0.5; // S/m, the brightest colour, unless a larger drop is there

const TABLE = Array.from({ length: STEPS }, (_, k) => {
  const at = (k / (STEPS - 1)) * (RAMP.length - 1);
  const low = Math.min(Math.floor(at), RAMP.length - 2);
  return RAMP[low].map((a, c) => Math.round(a + (at - low) * (RAMP[low + 1][c] - a)));
});

/** [red, green, blue] of a value from 0 to 1. */
export function colour(value) {
  return TABLE[Math.min(STEPS - 1, Math.max(0, Math.round(value * (STEPS - 1))))] ?? TABLE[0];
}

const PACKED = Uint32Array.from(TABLE, ([r, g, b]) => ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0); // as canvases lie in memory

/** Draw values [row 0 at the lowest y] into a canvas of one pixel each, `top` being the brightest. */
export function paint(canvas, values, rows, columns, top) {
  if (canvas.width !== columns || canvas.height !== rows) [canvas.width, canvas.height] = [columns, rows];
  const context = canvas.getContext("2d");
  const image = context.createImageData(columns, rows), pixels = new Uint32Array(image.data.buffer);
  const share = (STEPS - 1) / top;
  for (let row = 0; row < rows; row++) {
    const from = row * columns, to = (rows - 1 - row) * columns;
    for (let column = 0; column < columns; column++) {
      const at = values[from + column] * share;
      pixels[to + column] = PACKED[at > 0 ? Math.min(STEPS - 1, Math.round(at)) : 0];
    }
  }
  context.putImageData(image, 0, 0);
}

/** Of the electrodes' states, as the service numbers them. */
export const SIGNS = ["", "×", "=", "?", "~", "⇄", "#"];
const WELL = "#2f9e44", BROKEN = "#d6336c", DOUBTFUL = "#b35c00";
const STATES = [WELL, BROKEN, BROKEN, DOUBTFUL, DOUBTFUL];
/** An electrode's colour by its state. */
export function stateColour(state) { return STATES[state] ?? BROKEN; }

const LINES = ["#e8590c", "#1c7ed6", "#2f9e44", "#ae3ec9", "#e03131", "#0c8599"];
/** A contact's colour by its id. */
export function lineColour(id) { return LINES[id % LINES.length]; }
