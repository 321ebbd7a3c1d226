// Writes a film as a GIF (GIF89a): of each picture what has changed, in 255 colours.

const CLEAR = 256; // the code that empties the table of strings; the next one ends a picture
const MOST_CODES = 4096;
const SAME = 255; // the colour of a pixel that is as in the picture before

/** A colour of 15 bits for a pixel: five of red, green and blue each. */
const coarse = (pixels, at) =>
  (pixels[at] >> 3) << 10 | (pixels[at + 1] >> 3) << 5 | pixels[at + 2] >> 3;

/** The most frequent colours of some pictures; each is the mean of the pixels it stands for. */
function choosePalette(pictures) {
  const sums = new Float64Array(4 << 15); // red, green, blue and the number of pixels
  for (const pixels of pictures) {
    for (let at = 0; at < pixels.length; at += 4) {
      const bin = 4 * coarse(pixels, at);
      for (let k = 0; k < 3; k++) sums[bin + k] += pixels[at + k];
      sums[bin + 3]++;
    }
  }
  return Array.from({ length: 1 << 15 }, (_, bin) => [...sums.subarray(4 * bin, 4 * bin + 4)])
    .filter((each) => each[3]).sort((a, b) => b[3] - a[3]).slice(0, SAME)
    .map(([red, green, blue, count]) => [red, green, blue].map((sum) => Math.round(sum / count)));
}

/** Finds the nearest colour of a palette for each pixel, and remembers what it found. */
function makeMatcher(palette) {
  const known = new Int16Array(1 << 15).fill(-1);
  const away = (colour, pixels, at) =>
    colour.reduce((sum, part, k) => sum + (part - pixels[at + k]) ** 2, 0);
  return (pixels, at) => {
    const bin = coarse(pixels, at);
    if (known[bin] < 0) {
      const all = palette.map((colour) => away(colour, pixels, at));
      known[bin] = all.indexOf(Math.min(...all));
    }
    return known[bin];
  };
}

/** Compresses colours as GIF wants it: LZW with codes of 9 to 12 bits, in blocks of 255 bytes. */
function squeeze(colours) {
  const bytes = [8]; // bits of a colour
  const next = new Uint16Array(MOST_CODES << 8); // the code of a string and one more colour
  let [free, width, held, bits, block] = [CLEAR + 2, 9, 0, 0, 0];
  const put = (byte) => {
    if (!block || bytes.length - block > 255) block = bytes.push(0) - 1; // the length of the block
    bytes.push(byte);
    bytes[block]++;
  };
  const write = (code) => {
    held |= code << bits;
    for (bits += width; bits >= 8; bits -= 8, held >>>= 8) put(held & 255);
  };
  write(CLEAR);
  let [code] = colours;
  for (let i = 1; i < colours.length; i++) {
    const string = code << 8 | colours[i];
    if (next[string]) {
      code = next[string];
      continue;
    }
    write(code);
    code = colours[i];
    if (free < MOST_CODES) {
      if (free === 1 << width) width++;
      next[string] = free++;
    } else {
      write(CLEAR);
      next.fill(0);
      [free, width] = [CLEAR + 2, 9];
    }
  }
  write(code);
  if (free === 1 << width && width < 12) width++; // the reader has added a string by now
  write(CLEAR + 1);
  if (bits) put(held & 255);
  return Uint8Array.from([...bytes, 0]);
}

/**
 * Writes a film that repeats for ever; resolves to the parts of the file.
 * `draw(k)` returns the pixels of picture k of `count`, four bytes each, `pause` is its time in s,
 * and `report` hears the share that is done.
 */
async function writeGif(width, height, count, pause, draw, report) {
  const word = (number) => [number & 255, number >> 8];
  const samples = [0, 0.25, 0.5, 0.75, 1].map((share) => draw(Math.round(share * (count - 1))));
  const palette = choosePalette(samples);
  const match = makeMatcher(palette);
  const colours = palette.flat();
  const letters = (text) => [...text].map((letter) => letter.charCodeAt(0));
  const parts = [Uint8Array.from([...letters("GIF89a"), ...word(width), ...word(height), 0xf7, 0, 0,
    ...colours, ...Array(768 - colours.length).fill(0),
    0x21, 0xff, 11, ...letters("NETSCAPE2.0"), 3, 1, 0, 0, 0])];
  const before = new Uint8Array(width * height).fill(SAME);
  for (let k = 0; k < count; k++) {
    const pixels = draw(k);
    const changed = before.map((old, i) => {
      const now = match(pixels, 4 * i);
      before[i] = now;
      return now === old ? SAME : now;
    });
    const hold = Math.round(100 * (k === count - 1 ? 1 : pause)); // the last one stays for a second
    parts.push(Uint8Array.from([0x21, 0xf9, 4, 5, ...word(hold), SAME, 0,
      0x2c, 0, 0, 0, 0, ...word(width), ...word(height), 0]), squeeze(changed));
    report((k + 1) / count);
    await new Promise((resolve) => setTimeout(resolve)); // lets the page live
  }
  return [...parts, Uint8Array.of(0x3b)];
}
