// The compiled simulator: calls of its functions, whose arguments and results are in its linear memory.

const decoder = new TextDecoder();

/** An error that the simulator describes in one line. */
export class Refused extends Error {}

export class Simulator {
  /** Compiles the module at `url`, which is compressed by gzip. */
  static async load(url) {
    const response = await fetch(url);
    if (!response.ok) throw new Error(`${url}: ${response.status} ${response.statusText}`);
    return new Simulator(await WebAssembly.compile(await decompressed(await response.blob())));
  }

  constructor(module) {
    this.module = module;
    this.start();
  }

  /** Starts a new instance. One that has trapped cannot be used any more. */
  start() {
    this.exports = new WebAssembly.Instance(this.module, {}).exports;
  }

  /** Calls a function that returns JSON. */
  json(name, ...args) {
    this.call(name, ...args);
    return JSON.parse(decoder.decode(this.output()));
  }

  /** Calls a function that takes the contents of a file and returns JSON. */
  read(name, bytes, ...args) {
    const address = this.exports.reserve(bytes.length);
    new Uint8Array(this.exports.memory.buffer, address, bytes.length).set(bytes);
    return this.json(name, ...args);
  }

  call(name, ...args) {
    if (this.exports[name](...args) !== 1) throw new Refused(decoder.decode(this.output()));
  }

  /** Returns the output. The next call invalidates it. */
  output() {
    return new Uint8Array(this.exports.memory.buffer, this.exports.output(), this.exports.output_length());
  }
}

/** Decompresses a file, unless the server has declared the compression and the browser has undone it. */
export async function decompressed(blob) {
  const [first, second] = new Uint8Array(await blob.slice(0, 2).arrayBuffer());
  const isCompressed = first === 0x1f && second === 0x8b;
  const stream = isCompressed ? blob.stream().pipeThrough(new DecompressionStream("gzip")) : blob.stream();
  return new Response(stream).arrayBuffer();
}
