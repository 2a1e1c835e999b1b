// msgpack as the service writes it: no extension types. Arrays {dtype, shape, data} become typed arrays with a shape.

const TEXT = new TextDecoder("utf-8", { fatal: true });
const NUMBERS = { "<f4": Float32Array, "<f8": Float64Array, "|u1": Uint8Array, "|b1": Uint8Array, "<i8": BigInt64Array,
  "<c8": Float32Array };
const DEEPEST = 32;

class Reader {
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.at = 0;
  }

  skip(n) {
    const from = this.at;
    if (from + n > this.bytes.length) throw new RangeError("the message ends too soon");
    this.at += n;
    return from;
  }

  uint(size) {
    const from = this.skip(size);
    if (size === 1) return this.view.getUint8(from);
    if (size === 2) return this.view.getUint16(from);
    if (size === 4) return this.view.getUint32(from);
    return Number(this.view.getBigUint64(from)); // nanoseconds: exact to 2 ns after a hundred days
  }

  int(size) {
    const from = this.skip(size);
    if (size === 1) return this.view.getInt8(from);
    if (size === 2) return this.view.getInt16(from);
    if (size === 4) return this.view.getInt32(from);
    return Number(this.view.getBigInt64(from));
  }

  binary(n) {
    const from = this.skip(n);
    return this.bytes.subarray(from, from + n);
  }

  text(n) { return TEXT.decode(this.binary(n)); }

  list(n, depth) {
    if (n > this.bytes.length) throw new RangeError("a list longer than the message");
    return Array.from({ length: n }, () => this.value(depth + 1));
  }

  map(n, depth) {
    const found = Object.create(null); // a key is never a property that all objects have
    for (let k = 0; k < n; k++) {
      const key = String(this.value(depth + 1));
      found[key] = this.value(depth + 1);
    }
    return "dtype" in found && "shape" in found && "data" in found ? typed(found) : found;
  }

  value(depth = 0) {
    if (depth > DEEPEST) throw new RangeError("a value too deep");
    const tag = this.uint(1);
    if (tag < 0x80) return tag;
    if (tag < 0x90) return this.map(tag & 15, depth);
    if (tag < 0xa0) return this.list(tag & 15, depth);
    if (tag < 0xc0) return this.text(tag & 31);
    if (tag >= 0xe0) return tag - 256;
    switch (tag) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xc4: case 0xc5: case 0xc6: return this.binary(this.uint(1 << (tag - 0xc4)));
      case 0xca: return this.view.getFloat32(this.skip(4));
      case 0xcb: return this.view.getFloat64(this.skip(8));
      case 0xcc: case 0xcd: case 0xce: case 0xcf: return this.uint(1 << (tag - 0xcc));
      case 0xd0: case 0xd1: case 0xd2: case 0xd3: return this.int(1 << (tag - 0xd0));
      case 0xd9: case 0xda: case 0xdb: return this.text(this.uint(1 << (tag - 0xd9)));
      case 0xdc: case 0xdd: return this.list(this.uint(tag === 0xdc ? 2 : 4), depth);
      case 0xde: case 0xdf: return this.map(this.uint(tag === 0xde ? 2 : 4), depth);
      default: throw new TypeError(`no msgpack: 0x${tag.toString(16)}`);
    }
  }
}

function typed({ dtype, shape, data }) {
  const kind = NUMBERS[dtype];
  if (!kind || !(data instanceof Uint8Array) || !Array.isArray(shape)) return { dtype, shape, data };
  const copy = data.slice(); // its place in the message is not aligned
  const values = new kind(copy.buffer, 0, copy.length / kind.BYTES_PER_ELEMENT);
  values.shape = shape;
  return values;
}

/** The value of a whole message. Throws where it is none. */
export function decode(bytes) {
  return new Reader(bytes).value();
}

/** {topic, skin, frame} of a message of the wire: the topic, a 0 byte, a map. Throws where it is none. */
export function frameOf(bytes) {
  const zero = bytes.indexOf(0);
  const [topic, skin] = TEXT.decode(bytes.subarray(0, zero)).split("/");
  return { topic, skin, frame: decode(bytes.subarray(zero + 1)) };
}
