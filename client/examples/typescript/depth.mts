// Live depth over HTTP with nothing but fetch: for Node 22.18 and newer, Deno, Bun and browsers.
//
//     node depth.mts http://127.0.0.1:8000 LEFT.jpg RIGHT.jpg 640 480 FX_PX BASELINE_M
//
// Numbers of fields and enums are those of ../../../proto/vergence_proto/v1/depth.proto.

export type Rig = { width: number; height: number; fx: number; baseline_m: number };
export type DepthMap = { frameId: number; width: number; height: number; depth_m: Float32Array };
type Fields = Map<number, (bigint | Uint8Array)[]>;

// Protobuf: a message is a list of fields, and a field begins with number * 8 + type.
const concat = (...parts: Uint8Array[]) => new Uint8Array(parts.flatMap((part) => [...part]));

function varint(value: bigint): Uint8Array {
  const bytes: number[] = [];
  for (; value > 127n; value >>= 7n) bytes.push(Number(value & 127n) | 128);
  return new Uint8Array([...bytes, Number(value)]);
}

const int = (field: number, value: number | bigint) => concat(varint(BigInt(field * 8)), varint(BigInt(value)));
const double = (field: number, value: number) =>
  concat(varint(BigInt(field * 8 + 1)), new Uint8Array(new Float64Array([value]).buffer));

function message(field: number, ...parts: Uint8Array[]): Uint8Array<ArrayBuffer> {
  const size = parts.reduce((sum, part) => sum + part.length, 0);
  const head = concat(varint(BigInt(field * 8 + 2)), varint(BigInt(size)));
  const whole = new Uint8Array(head.length + size);
  let at = 0;
  for (const part of [head, ...parts]) (whole.set(part, at), (at += part.length));
  return whole;
}

function readVarint(data: Uint8Array, at: number): [bigint, number] {
  let value = 0n;
  for (let shift = 0n; ; shift += 7n) {
    const byte = BigInt(data[at++]);
    value |= (byte & 127n) << shift;
    if (byte < 128n) return [value, at];
  }
}

function fieldsOf(data: Uint8Array): Fields {
  const fields: Fields = new Map();
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  for (let at = 0; at < data.length; ) {
    let [head, value]: [bigint, bigint | Uint8Array] = [0n, 0n];
    [head, at] = readVarint(data, at);
    const [field, type] = [Number(head >> 3n), Number(head & 7n)];
    if (type === 0) [value, at] = readVarint(data, at);
    else if (type === 1) (value = view.getBigUint64(at, true)), (at += 8);
    else if (type === 5) (value = BigInt(view.getUint32(at, true))), (at += 4);
    else {
      const [size, start] = readVarint(data, at);
      at = start + Number(size);
      value = data.subarray(start, at);
    }
    fields.set(field, [...(fields.get(field) ?? []), value]);
  }
  return fields;
}

const numberOf = (fields: Fields, field: number) => Number(fields.get(field)?.[0] ?? 0);
const inner = (fields: Fields, field: number) => fields.get(field)?.[0] as Uint8Array | undefined;

/** Unpack a plane of COMPRESSION_DELTA_DEFLATE and UINT16: pixels of disparity, NaN without a value. */
async function disparityOf(plane: Fields): Promise<[Float32Array, number, number]> {
  const [width, height] = [numberOf(plane, 3), numberOf(plane, 4)];
  const packed = new Blob([inner(plane, 5)!.slice()]).stream();
  const unpacked = packed.pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(unpacked).arrayBuffer());
  const size = width * height;
  const stored = new Uint16Array(size);
  for (let i = 0; i < size; i++) {
    const folded = bytes[i] | (bytes[size + i] << 8);
    stored[i] = ((folded >> 1) ^ -(folded & 1)) + (i < width ? 0 : stored[i - width]);
  }
  return [Float32Array.from(stored, (n) => (n ? n / numberOf(plane, 6) : NaN)), width, height];
}

/** The messages of a response that lasts as long as the call: a kind, a length, and the content. */
async function* records(response: Response): AsyncGenerator<[number, Uint8Array]> {
  let rest = new Uint8Array();
  for await (const chunk of response.body as unknown as AsyncIterable<Uint8Array>) {
    const joined = new Uint8Array(rest.length + chunk.length);
    (joined.set(rest), joined.set(chunk, rest.length), (rest = joined));
    while (rest.length >= 5) {
      const size = new DataView(rest.buffer, rest.byteOffset).getUint32(1);
      if (rest.length < 5 + size) break;
      yield [rest[0], rest.subarray(5, 5 + size)];
      rest = rest.slice(5 + size);
    }
  }
}

function opening(rig: Rig): Uint8Array<ArrayBuffer> {
  const camera = [int(1, rig.width), int(2, rig.height), double(3, rig.fx), double(4, rig.fx)];
  camera.push(double(5, (rig.width - 1) / 2), double(6, (rig.height - 1) / 2));
  const pose = [message(1, double(4, 1)), message(2, double(1, rig.baseline_m))]; // quaternion 0 0 0 1
  const output = message(6, int(1, 1), int(2, 16), int(3, 3), int(6, 2)); // UINT16 at 1/16 px, deflate, half
  return message(1, message(3, message(1, ...camera), message(2, ...camera), message(3, ...pose)), int(5, 1), output);
}

/** A live stream: `submit` never waits, the newest frame wins, and iteration gives depth in metres. */
export class DepthStream {
  private url = "";
  private unanswered = new Set<number>();
  private credit = 1;
  private lastId = 0;
  private scale = 0; // fx * baseline
  private server: string;
  private headers: Record<string, string>;

  constructor(server: string, token = "") {
    this.server = server;
    this.headers = { "Content-Type": "application/x-protobuf" };
    if (token) this.headers["Authorization"] = `Bearer ${token}`;
  }

  async *depth(rig: Rig): AsyncGenerator<DepthMap> {
    const request = { method: "POST", headers: this.headers, body: opening(rig) };
    const response = await fetch(`${this.server}/v1/streams`, request);
    if (!response.ok) throw new Error(`${response.status}: ${await response.text()}`);
    const callUrl = `${this.server}/v1/streams/${response.headers.get("X-Call-Id")}`;
    for await (const [kind, content] of records(response)) {
      const fields = fieldsOf(content);
      if (kind === 1) {
        if (content.length) throw new Error(new TextDecoder().decode(inner(fields, 3)));
        return;
      }
      const [[field, [value]]] = fields; // one field of the oneof
      const answer = fieldsOf(value as Uint8Array);
      if (field === 1) {
        const rectified = fieldsOf(inner(answer, 4)!);
        const real = (number: number) => new Float64Array(new BigUint64Array([rectified.get(number)![0] as bigint]).buffer)[0];
        this.scale = real(3) * real(8);
        (this.credit = numberOf(answer, 3)), (this.url = callUrl);
      } else if (field === 2) {
        const frameId = numberOf(answer, 1);
        this.unanswered.delete(frameId);
        const [disparity, width, height] = await disparityOf(fieldsOf(inner(answer, 3)!));
        yield { frameId, width, height, depth_m: disparity.map((pixels) => this.scale / pixels) };
      } else if (field === 3) {
        this.unanswered.delete(numberOf(answer, 1));
        console.error(new TextDecoder().decode(inner(answer, 3)));
      } else if (field === 4) {
        const dropped = inner(answer, 1)!; // displaced by newer frames
        for (let [id, at] = [0n, 0]; at < dropped.length; this.unanswered.delete(Number(id))) {
          [id, at] = readVarint(dropped, at);
        }
      }
    }
  }

  /** Send two JPEG files of the rig's size; false: as many frames as the credit allows are unanswered. */
  submit(left: Uint8Array, right: Uint8Array, rig: Rig): boolean {
    if (!this.url || this.unanswered.size >= this.credit) return false;
    const image = (field: number, data: Uint8Array) =>
      message(field, int(1, 3), int(2, rig.width), int(3, rig.height), message(4, data));
    const captureNs = BigInt(Math.round(performance.now() * 1e6));
    this.unanswered.add(++this.lastId);
    this.post(message(2, int(1, this.lastId), int(2, captureNs), image(3, left), image(4, right)));
    return true;
  }

  /** End the stream; the iteration stops after the last answer. */
  end(): void {
    this.post(message(5));
  }

  private post(body: Uint8Array<ArrayBuffer>): void {
    fetch(this.url, { method: "POST", headers: this.headers, body }).catch((error) => console.error(error));
  }
}

if (typeof process !== "undefined" && process.argv[1]?.endsWith("depth.mts")) {
  const { readFile } = await import("node:fs/promises");
  const [server, left, right, ...numbers] = process.argv.slice(2);
  const [width, height, fx, baseline_m] = numbers.map(Number);
  const rig = { width, height, fx, baseline_m };
  const images = await Promise.all([readFile(left), readFile(right)]);
  const stream = new DepthStream(server, process.env.VERGENCE_TOKEN);
  const camera = setInterval(() => stream.submit(images[0], images[1], rig), 33);
  let count = 0;
  for await (const map of stream.depth(rig)) {
    const known = map.depth_m.filter((depth) => !Number.isNaN(depth)).sort();
    console.log(`frame ${map.frameId}: ${map.width}x${map.height}, median depth ${known[known.length >> 1].toFixed(3)} m`);
    if (++count === 5) (clearInterval(camera), stream.end());
  }
}
