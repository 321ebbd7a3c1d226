// Reads what swarmjax/replay/pack.py wrote.

/** Inflates the data of the page: the header, and all bytes, in which the series lie. */
async function unpack(base64) {
  const deflated = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const inflating = new Blob([deflated]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(inflating).arrayBuffer());
  const length = new DataView(bytes.buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
  let at = 4 + length;
  for (const episode of header.episodes) {
    for (const run of episode.runs) {
      run.at = at;
      for (const [, columns, width] of run.series) at += run.frames * columns * width;
    }
  }
  return { header, bytes };
}

/** Decodes one series: whole numbers, column by column. */
function unfold(bytes, at, rows, columns, width) {
  const count = rows * columns;
  const table = new Int32Array(count);
  for (let i = 0; i < count; i++) {
    let folded = 0;
    for (let plane = 0; plane < width; plane++) folded |= bytes[at + plane * count + i] << (8 * plane);
    const step = (folded >>> 1) ^ -(folded & 1);
    table[i] = i % rows ? table[i - 1] + step : step;
  }
  return table;
}

/** Opens one run: what each robot i was and did at frame t, in metres, radians and reward. */
function openRun(header, bytes, episode, run) {
  const { quanta, dark } = header;
  const rows = run.frames;
  const table = {};
  let at = run.at;
  for (const [name, columns, width] of run.series) {
    table[name] = unfold(bytes, at, rows, columns, width);
    at += rows * columns * width;
  }
  const terms = run.series.map(([name]) => name).filter((name) => name.startsWith("reward."));
  const row = (t) => Math.min(t, rows - 1); // a run that is over stays as it was
  const cell = (name, column, t) => table[name][column * rows + row(t)];
  const pose = (i, t) => [
    cell("x", i, t) * quanta.length,
    cell("y", i, t) * quanta.length,
    cell("yaw", i, t) * quanta.angle,
  ];
  const target = (i, t) => (table.target
    ? [2 * i, 2 * i + 1].map((column) => cell("target", column, t) * quanta.length)
    : episode.target[i]);
  return {
    robots: episode.target.length,
    last: rows - 1,
    pose,
    target,
    /** Length of ray k, or null where it meets nothing in range. */
    ray(i, k, t) {
      const whole = cell("ray", i * header.sensors + k, t);
      return whole === dark ? null : (whole + 0.5) * quanta.ray;
    },
    distance(i, t) {
      const [x, y] = pose(i, t);
      const [targetX, targetY] = target(i, t);
      return Math.hypot(x - targetX, y - targetY);
    },
    /** Reward since the start by term, [name, sum] each. */
    terms: (i, t) => terms.map((name) => [name.slice(7), cell(name, i, t) * quanta.reward]),
    reward: (i, t) => terms.reduce((sum, name) => sum + cell(name, i, t), 0) * quanta.reward,
    /** The goal's own measures so far. */
    measures: (t) => header.measures.map((_, k) => cell("measured", k, t) * quanta.measure),
    touches: (i, t) => cell("touch", i, t) > 0,
    /** Contacts since the start, one number a kind. */
    contacts: (i, t) => header.kinds.map((_, kind) =>
      cell("contacts", i * header.kinds.length + kind, t)),
    /** Whether it has arrived; a robot that may leave again has a series of its own. */
    arrived: (i, t) => (table.arrived
      ? cell("arrived", i, t) === 1
      : run.arrival[i] > 0 && t >= run.arrival[i]),
    /** The frame from which on it has arrived to the end, or 0. */
    arrival: (i) => run.arrival[i],
  };
}
