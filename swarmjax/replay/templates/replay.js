// Lets a person play the runs, and scripts too, through `window.replay`.

const SPEEDS = [0.25, 0.5, 1, 2, 4, 8, 16];
const TRAILS = [["off", 0], ["10 s", 10], ["whole", Infinity]]; // s
const LONGEST = 1; // s between two pictures that count: a page in a hidden tab waits
const REFRESH = 100; // ms between two readings of the numbers beside the pictures
const FILM = { rate: 12.5, most: 300, side: 480 }; // of a GIF: pictures a second, pictures, px

const page = (id) => document.getElementById(id);

/** Makes an element with attributes and children. */
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

const state = {
  header: null,
  bytes: null,
  views: [], // one a policy: what it is drawn on, its run, and its chart's layer
  episode: 0,
  frame: 0,
  last: 0,
  ranges: null, // of the charts
  playing: false,
  moment: 0, // s since the start, while playing
  clock: 0, // ms, of the last picture
  readAt: 0, // ms, of the last numbers
  look: null, // how robots are drawn
};

/** Opens an episode at its start. */
function openEpisode(number) {
  const { header, bytes } = state;
  pause();
  state.episode = number;
  const episode = header.episodes[number];
  const runs = episode.runs.map((run) => openRun(header, bytes, episode, run));
  state.last = Math.max(...runs.map((run) => run.last));
  state.ranges = chartRanges(runs);
  Object.assign(state.look, { colours: episode.colours, chosen: null });
  runs.forEach((run, i) => openView(state.views[i], episode, run));
  document.title = page("title").textContent = episode.label;
  page("episode").value = number;
  page("timeline").max = state.last;
  show(0);
}

/** Puts a run into its view. */
function openView(view, episode, run) {
  view.run = run;
  view.layer = null;
  view.arena.setAttribute("aria-label", `Top view of ${plural(run.robots, "robot")} `
    + `in an arena ${round(episode.side, 3)} m wide`);
  view.robots.replaceChildren(...Array.from({ length: run.robots }, (_, i) => robotItem(i)));
}

/** A button that singles a robot out, with its numbers. */
function robotItem(i) {
  const dot = make("i");
  dot.style.background = state.look.colours[i];
  const button = make("button", { type: "button", "aria-pressed": "false" },
    dot, make("span", { class: "number" }, `${i + 1}`), make("span", { class: "state" }));
  button.addEventListener("click", () => choose(i));
  return make("li", {}, button);
}

/** Singles a robot out; none, if it is null or was singled out. */
function choose(robot) {
  state.look.chosen = robot === state.look.chosen ? null : robot;
  for (const view of state.views) {
    view.layer = null;
    [...view.robots.children].forEach((item, i) =>
      item.firstChild.setAttribute("aria-pressed", String(i === state.look.chosen)));
  }
  show(state.frame);
}

/** Shows a frame of the open episode. */
function show(frame) {
  state.frame = Math.min(Math.max(0, Math.round(frame)), state.last);
  const scene = state.header.episodes[state.episode];
  for (const view of state.views) {
    if (view.arena.clientHeight) drawArena(view.arena, scene, view.run, state.frame, state.look);
    if (!view.chart.clientHeight || !view.chart.clientWidth) continue; // as in full screen
    fit(view.chart); // the layer is as large as the chart
    view.layer ??= drawCharts(view.chart, view.run, state.last, state.ranges, state.look);
    drawCursor(view.chart, view.layer, view.run, state.frame, state.last, state.ranges, state.look);
  }
  page("timeline").value = state.frame;
  const now = performance.now();
  if (state.playing && now - state.readAt < REFRESH) return;
  state.readAt = now;
  readNumbers();
}

/** Writes the numbers of the frame that is shown. */
function readNumbers() {
  const { frame, last, header } = state;
  const [now, end] = [frame, last].map((t) => (t * header.step).toFixed(2));
  page("time").textContent = `${now} of ${end} s`;
  page("step").textContent = `, step ${frame} of ${last}`;
  page("timeline").setAttribute("aria-valuetext", `${now} of ${end} seconds`);
  for (const view of state.views) {
    view.status.textContent = describeRun(view.run, frame);
    [...view.robots.children].forEach((item, i) => {
      const there = view.run.arrived(i, frame);
      const distance = view.run.distance(i, frame).toFixed(2);
      item.querySelector(".state").textContent =
        `${distance} m, ${signed(view.run.reward(i, frame), 2)}${there ? " ✓" : ""}`;
      item.firstChild.setAttribute("aria-label", `Robot ${i + 1}: ${distance} m from its target, `
        + `reward ${signed(view.run.reward(i, frame), 2)}${there ? `, ${atTarget(1)}` : ""}`);
    });
    view.detail.textContent = describeRobot(view.run, state.look.chosen, frame);
  }
}

/** Says how a swarm stands. */
function describeRun(run, t) {
  const robots = [...Array(run.robots).keys()];
  const there = robots.filter((i) => run.arrived(i, t)).length;
  const contacts = robots.flatMap((i) => run.contacts(i, t)).reduce((sum, n) => sum + n, 0);
  const over = t >= run.last && run.last < state.last ? `, over at ${seconds(run.last)}` : "";
  const measured = run.measures(t).map((value, k) => {
    const [label, unit] = state.header.measures[k];
    const shown = unit === "%" ? round(100 * value, 1) : round(value, 2);
    return `, ${label} ${shown} ${unit}`.trimEnd();
  });
  return `${there} of ${run.robots} ${atTarget(run.robots)}, ${plural(contacts, "contact")}`
    + measured.join("") + over;
}

/** Says how one robot stands, its reward term by term. */
function describeRobot(run, robot, t) {
  if (robot === null) return "";
  const terms = run.terms(robot, t).map(([name, sum]) => `${name} ${signed(sum, 3)}`).join(", ");
  const met = run.contacts(robot, t)
    .map((count, kind) => (count ? `${count} with ${state.header.kinds[kind]}` : ""))
    .filter(Boolean).join(", ");
  const since = run.arrival(robot);
  const when = since && t >= since ? ` ${holds() ? "since" : "at"} ${seconds(since)}` : "";
  const arrival = run.arrived(robot, t) ? `; ${atTarget(1)}${when}` : "";
  return `Robot ${robot + 1}: ${run.distance(robot, t).toFixed(3)} m to go; reward `
    + `${signed(run.reward(robot, t), 3)} (${terms}); contacts: ${met || "none"}${arrival}`;
}

/** Whether robots drive on within their targets, and may leave them again. */
const holds = () => state.header.arrival === "hold";
const atTarget = (count) => {
  if (!holds()) return "arrived";
  return count === 1 ? "within its target" : "within their targets";
};
const seconds = (frame) => `${(frame * state.header.step).toFixed(2)} s`;
const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
const signed = (value, digits) => value.toFixed(digits).replace(/^-(?=0(\.0*)?$)/, "")
  .replace("-", "−");

// Playing

function play() {
  if (state.playing) return;
  if (state.frame >= state.last) show(0);
  state.playing = true;
  state.moment = state.frame * state.header.step;
  state.clock = performance.now();
  page("play").textContent = "Pause";
  requestAnimationFrame(tick);
}

function pause() {
  state.playing = false;
  page("play").textContent = "Play";
  if (state.ranges) readNumbers(); // which may be older than the pictures; before that, none are shown
}

function tick(now) {
  if (!state.playing) return;
  const passed = Math.min(Math.max(0, now - state.clock) / 1000, LONGEST);
  state.clock = now;
  state.moment += passed * Number(page("speed").value);
  const frame = Math.floor(state.moment / state.header.step);
  if (frame >= state.last) pause();
  if (frame !== state.frame) show(frame);
  if (state.playing) requestAnimationFrame(tick);
}

/** Goes to a frame, where playing goes on from. */
function seek(frame) {
  show(frame);
  state.moment = state.frame * state.header.step;
  if (!state.playing) readNumbers();
}

function changeSpeed(by) {
  const at = SPEEDS.indexOf(Number(page("speed").value)) + by;
  page("speed").value = SPEEDS[Math.min(Math.max(0, at), SPEEDS.length - 1)];
}

function changeEpisode(by) {
  const count = state.header.episodes.length;
  if (count > 1) openEpisode((state.episode + by + count) % count);
}

function onKey(event) {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const { tagName } = event.target;
  if (tagName === "SELECT" || (tagName !== "BODY" && [" ", "Enter"].includes(event.key)
    && event.target.id !== "timeline")) return; // a button that has the focus is pressed
  const second = Math.round(1 / state.header.step);
  const stride = event.shiftKey ? second : 1;
  const action = {
    " ": () => (state.playing ? pause() : play()),
    ArrowLeft: () => seek(state.frame - stride),
    ArrowRight: () => seek(state.frame + stride),
    Home: () => seek(0),
    End: () => seek(state.last),
    "+": () => changeSpeed(1),
    "=": () => changeSpeed(1),
    "-": () => changeSpeed(-1),
    n: () => changeEpisode(1),
    p: () => changeEpisode(-1),
    f: toggleFullScreen,
  }[event.key];
  if (!action) return;
  event.preventDefault();
  action();
}

// Full screen and film

function toggleFullScreen() {
  if (!document.fullscreenEnabled) return;
  if (document.fullscreenElement) document.exitFullscreen();
  else page("content").requestFullscreen();
  page("play").focus(); // so that the space bar plays and pauses
}

function nameFullScreen() {
  page("full").textContent = document.fullscreenElement ? "Leave full screen" : "Full screen";
}

/** Films the open episode at the speed of the page, faster if it is too long; resolves to a GIF. */
async function film(report = () => {}) {
  const { header, last } = state;
  const { rate, most, side } = FILM;
  const [scene, look] = [header.episodes[state.episode], { ...state.look }];
  const runs = state.views.map((view) => view.run);
  const [width, height] = [side * runs.length, side + FOOT];
  const arena = make("canvas", { width: side, height });
  const context = make("canvas", { width, height }).getContext("2d", { willReadFrequently: true });
  const stride = Math.max(Number(page("speed").value) / (rate * header.step), last / (most - 1));
  const draw = (picture) => {
    const t = Math.min(last, Math.round(picture * stride));
    context.fillStyle = look.theme.card;
    context.fillRect(0, 0, width, height);
    runs.forEach((run, i) => {
      drawArena(arena, scene, run, t, look);
      context.drawImage(arena, i * side, 0);
    });
    context.fillStyle = look.theme.soft;
    context.font = "12px system-ui, sans-serif";
    context.textAlign = "right";
    context.fillText(`${(t * header.step).toFixed(1)} s`, width - 8, height - 8);
    return context.getImageData(0, 0, width, height).data;
  };
  const count = 1 + Math.ceil(last / stride);
  return new Blob(await writeGif(width, height, count, 1 / rate, draw, report),
    { type: "image/gif" });
}

async function saveGif() {
  const button = page("gif");
  const name = `episode-${state.header.episodes[state.episode].level}.gif`;
  button.disabled = true;
  try {
    const gif = await film((share) => {
      button.textContent = `Making it: ${Math.round(100 * share)} %`;
    });
    const href = URL.createObjectURL(gif);
    make("a", { href, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(href), 60_000); // once it has been saved
  } finally {
    button.disabled = false;
    button.textContent = "Save as GIF";
  }
}

// The page

/** Makes the view of one policy. */
function makeView(label, number) {
  const head = `policy-${number}`;
  const view = {
    status: make("p", { class: "status" }),
    arena: make("canvas", { class: "arena", role: "img" }),
    chart: make("canvas", { class: "chart", role: "img",
      "aria-label": "Distance to target and reward so far of each robot over time" }),
    robots: make("ul", { class: "robots", "aria-label": "Robots" }),
    detail: make("p", { class: "detail" }),
  };
  page("runs").append(make("section", { class: "run", "aria-labelledby": head },
    make("div", { class: "head" }, make("h2", { id: head }, label), view.status),
    view.arena,
    make("div", { class: "side" }, view.chart,
      make("p", { class: "status" }, "Robots: distance to target, reward so far"),
      view.robots, view.detail)));
  view.arena.addEventListener("click", (event) => choose(robotAt(
    view.arena, state.header.episodes[state.episode], view.run, state.frame,
    event.offsetX, event.offsetY)));
  view.chart.addEventListener("pointerdown", (event) => {
    view.chart.setPointerCapture(event.pointerId);
    seekOnChart(view, event);
  });
  view.chart.addEventListener("pointermove", (event) => {
    if (view.chart.hasPointerCapture(event.pointerId)) seekOnChart(view, event);
  });
  return view;
}

function seekOnChart(view, event) {
  const { clientWidth, clientHeight } = view.chart;
  const left = view.chart.getBoundingClientRect().left;
  const place = placeCharts(clientWidth, clientHeight, state.last, state.ranges);
  seek(place.frame(event.clientX - left));
}

/** Draws everything anew, for another size or other colours. */
function redraw() {
  state.look.theme = readTheme();
  for (const view of state.views) view.layer = null;
  show(state.frame);
}

/** How many frames of a trail are drawn; a whole number, since frames have no points between. */
function trailFrames() {
  return Math.round(TRAILS[page("trails").selectedIndex][1] / state.header.step);
}

function setTrail() {
  state.look.trail = trailFrames();
  show(state.frame);
}

/** Fills the page in for what it holds. */
function buildPage() {
  const { header } = state;
  page("about").textContent = header.about;
  page("range").textContent = `infrared ray shorter than ${round(100 * header.range, 2)} cm`;
  for (const [what, text] of header.facts) {
    page("facts").append(make("dt", {}, what), make("dd", {}, text));
  }
  for (const speed of SPEEDS) page("speed").append(make("option", { value: speed }, `${speed}×`));
  page("speed").value = 1;
  for (const [name] of TRAILS) page("trails").append(make("option", {}, name));
  header.episodes.forEach((episode, i) => {
    page("episode").append(
      make("option", { value: i }, episode.label.replace(/^Episode /, "")));
  });
  page("runs").className = header.policies.length > 1 ? "two" : "one";
  state.views = header.policies.map(makeView);
  const { hull, range, targetRadius, step } = header;
  const few = header.episodes.every((episode) => episode.target.length <= FEW);
  page("trails").selectedIndex = few ? 2 : 1;
  const trail = trailFrames();
  state.look = { hull, range, targetRadius, step, trail, colours: null, chosen: null, theme: readTheme() };
}

function listen() {
  page("play").addEventListener("click", () => (state.playing ? pause() : play()));
  page("back").addEventListener("click", () => seek(state.frame - 1));
  page("forth").addEventListener("click", () => seek(state.frame + 1));
  page("timeline").addEventListener("input", (event) => seek(Number(event.target.value)));
  page("trails").addEventListener("change", setTrail);
  page("episode").addEventListener("change", (event) => openEpisode(Number(event.target.value)));
  page("full").hidden = !document.fullscreenEnabled;
  page("full").addEventListener("click", toggleFullScreen);
  page("gif").addEventListener("click", saveGif);
  document.addEventListener("fullscreenchange", nameFullScreen);
  document.addEventListener("keydown", onKey);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  new ResizeObserver(redraw).observe(page("runs"));
}

/** What scripts may use. `run` is 0 for the first policy, 1 for the second. */
function publish() {
  const perRobot = (read) => (i = state.frame, run = 0) => {
    const found = state.views[run].run;
    return Array.from({ length: found.robots }, (_, robot) => read(found, robot, i));
  };
  window.replay = Object.freeze({
    ready: true,
    get episodes() { return state.header.episodes.length; },
    get episode() { return state.episode; },
    get level() { return state.header.episodes[state.episode].level; },
    get frames() { return state.last + 1; },
    get frame() { return state.frame; },
    get playing() { return state.playing; },
    get speed() { return Number(page("speed").value); },
    open: openEpisode,
    seek,
    play,
    pause,
    gif: () => film(),
    positions: perRobot((run, robot, t) => run.pose(robot, t)),
    distances: perRobot((run, robot, t) => run.distance(robot, t)),
    rewards: perRobot((run, robot, t) => run.reward(robot, t)),
    rays: perRobot((run, robot, t) =>
      Array.from({ length: state.header.sensors }, (_, k) => run.ray(robot, k, t))),
  });
}

async function begin() {
  if (!("DecompressionStream" in window)) {
    throw new Error("this browser is too old: it has no DecompressionStream");
  }
  Object.assign(state, await unpack(page("data").textContent.trim()));
  buildPage();
  page("content").hidden = false;
  openEpisode(0);
  listen();
  publish();
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) play();
}

begin().catch((error) => {
  page("trouble").textContent = `The replay cannot be shown: ${error.message}.`;
  page("trouble").hidden = false;
});
