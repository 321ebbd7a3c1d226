// Draws a top view and the charts of a run on canvases. Lengths in metres, y up; text in pixels.

const FEW = 10; // of as many robots all rays are shown

/** The page's colours as they are now, light or dark. */
function readTheme() {
  const style = getComputedStyle(document.documentElement);
  const names = ["card", "ink", "soft", "line", "grid", "wall", "box", "ray", "dark-ray", "touch",
    "hull"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Fits a canvas to its place on the screen; returns a context that counts CSS pixels. */
function fit(canvas) {
  // A canvas of a film is in no page and keeps its own size.
  const isShown = canvas.isConnected;
  const width = isShown ? canvas.clientWidth : canvas.width;
  const height = isShown ? canvas.clientHeight : canvas.height;
  const ratio = (isShown && window.devicePixelRatio) || 1;
  const [columns, rows] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== columns || canvas.height !== rows) {
    canvas.width = columns;
    canvas.height = rows;
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

// The top view

const FRAME = 0.012; // m of wall that are shown
const FOOT = 22; // px for the scale
const FINGER = 24; // px from the middle of a robot that still mean it

/** Where metres lie on a canvas. */
function placeArena(width, height, side) {
  const scale = Math.min(width, height - FOOT) / (side + 2 * FRAME);
  return {
    scale,
    x: (x) => width / 2 + scale * x,
    y: (y) => (height - FOOT) / 2 - scale * y,
  };
}

const MOST_POINTS = 20000; // of all trails together

function drawArena(canvas, scene, run, t, look) {
  const { context, width, height } = fit(canvas);
  const place = placeArena(width, height, scene.side);
  const order = [...Array(run.robots).keys()];
  if (look.chosen !== null) order.push(...order.splice(look.chosen, 1)); // on top of the others
  drawWalls(context, place, scene, look.theme);
  drawScale(context, place, scene.side, height, look.theme);
  const alpha = (i) => look.chosen === null || look.chosen === i ? 1 : 0.3;
  for (const draw of [drawTarget, drawTrail, drawRobot, drawRays]) {
    for (const i of order) {
      context.globalAlpha = alpha(i);
      draw(context, place, scene, run, i, t, look);
    }
  }
  context.globalAlpha = 1;
}

/** The distance of grid lines: a round length that shows as 40 pixels or more. */
function gridStep(scale) {
  return [0.1, 0.2, 0.5, 1].find((step) => step * scale >= 40) ?? 2;
}

/** The robot at a point of the canvas, or null. */
function robotAt(canvas, scene, run, t, x, y) {
  const place = placeArena(canvas.clientWidth, canvas.clientHeight, scene.side);
  const away = Array.from({ length: run.robots }, (_, i) => {
    const [robotX, robotY] = run.pose(i, t);
    return Math.hypot(place.x(robotX) - x, place.y(robotY) - y);
  });
  const nearest = away.indexOf(Math.min(...away));
  return away[nearest] <= FINGER ? nearest : null;
}

function drawWalls(context, place, scene, theme) {
  const half = scene.side / 2;
  const square = (radius) => context.rect(
    place.x(-radius), place.y(radius), 2 * radius * place.scale, 2 * radius * place.scale);
  context.strokeStyle = theme.grid;
  context.lineWidth = 1;
  context.beginPath();
  const step = gridStep(place.scale);
  for (let at = -Math.floor(half / step) * step; at < half; at += step) {
    context.moveTo(place.x(at), place.y(-half));
    context.lineTo(place.x(at), place.y(half));
    context.moveTo(place.x(-half), place.y(at));
    context.lineTo(place.x(half), place.y(at));
  }
  context.stroke();
  // One path: if each box were filled alone, the floor would shine through where two of them meet.
  context.fillStyle = theme.box;
  context.beginPath();
  for (const box of scene.box) addBox(context, place, box);
  context.fill();
  context.fillStyle = theme.wall;
  context.beginPath();
  square(half + FRAME);
  square(half);
  context.fill("evenodd");
}

function addBox(context, place, [x, y, yaw, halfX, halfY]) {
  context.save();
  context.translate(place.x(x), place.y(y));
  context.rotate(-yaw);
  context.rect(-halfX * place.scale, -halfY * place.scale,
    2 * halfX * place.scale, 2 * halfY * place.scale);
  context.restore();
}

function drawScale(context, place, side, height, theme) {
  const step = gridStep(place.scale);
  const [left, bottom] = [place.x(-side / 2), height - 8];
  context.strokeStyle = context.fillStyle = theme.soft;
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(left, bottom - 4);
  context.lineTo(left, bottom);
  context.lineTo(left + step * place.scale, bottom);
  context.lineTo(left + step * place.scale, bottom - 4);
  context.stroke();
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = "alphabetic";
  context.fillText(`${step} m; arena ${round(side, 3)} m wide`, left + step * place.scale + 8, bottom);
}

function drawTarget(context, place, scene, run, i, t, look) {
  const [x, y] = run.target(i, t);
  context.strokeStyle = context.fillStyle = look.colours[i];
  context.lineWidth = 1.5;
  context.beginPath();
  context.arc(place.x(x), place.y(y), look.targetRadius * place.scale, 0, 2 * Math.PI);
  if (run.arrived(i, t)) {
    const alpha = context.globalAlpha;
    context.globalAlpha = 0.25 * alpha;
    context.fill();
    context.globalAlpha = alpha;
    context.stroke();
    return;
  }
  const isSmall = look.targetRadius * place.scale < 8;
  context.setLineDash(isSmall ? [] : [4, 3]);
  context.stroke();
  if (look.chosen === i) {
    const [robotX, robotY] = run.pose(i, t);
    context.beginPath();
    context.moveTo(place.x(robotX), place.y(robotY));
    context.lineTo(place.x(x), place.y(y));
    context.setLineDash([4, 3]);
    context.stroke();
  }
  context.setLineDash([]);
  context.beginPath();
  context.arc(place.x(x), place.y(y), isSmall ? 1 : 2, 0, 2 * Math.PI);
  context.fill();
}

function drawTrail(context, place, scene, run, i, t, look) {
  if (!look.trail) return;
  const end = Math.min(t, run.last);
  context.strokeStyle = look.colours[i];
  context.lineWidth = 1.5;
  // Trails of a large swarm go through fewer points, always the same ones, so that it plays fluently.
  const every = Math.ceil(run.robots * Math.min(look.trail, run.last) / MOST_POINTS);
  const frames = [end];
  for (let at = end - 1; at >= Math.max(0, end - look.trail); at--) {
    if (at % every === 0) frames.push(at);
  }
  context.beginPath();
  for (const at of frames) {
    const [x, y] = run.pose(i, at);
    context.lineTo(place.x(x), place.y(y));
  }
  const alpha = context.globalAlpha;
  context.globalAlpha = 0.55 * alpha;
  context.stroke();
  context.globalAlpha = alpha;
}

function drawRays(context, place, scene, run, i, t, look) {
  const [x, y, yaw] = run.pose(i, t);
  const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
  const all = run.robots <= FEW || look.chosen === i;
  const sensors = scene.sensor[i] ?? scene.sensor[0];
  sensors.forEach(([ahead, aside, towardX, towardY], k) => {
    const length = run.ray(i, k, t);
    if (length === null && !all) return;
    const from = [x + cos * ahead - sin * aside, y + sin * ahead + cos * aside];
    const reach = length ?? look.range;
    const to = [from[0] + reach * (cos * towardX - sin * towardY),
      from[1] + reach * (sin * towardX + cos * towardY)];
    drawRay(context, place, from, to, length !== null, look.theme);
  });
}

function drawRay(context, place, from, to, lit, theme) {
  context.strokeStyle = context.fillStyle = lit ? theme.ray : theme["dark-ray"];
  context.lineWidth = lit ? 2.5 : 1;
  context.beginPath();
  context.moveTo(place.x(from[0]), place.y(from[1]));
  context.lineTo(place.x(to[0]), place.y(to[1]));
  context.stroke();
  if (!lit) return;
  context.beginPath();
  context.arc(place.x(to[0]), place.y(to[1]), 2.5, 0, 2 * Math.PI);
  context.fill();
}

function drawRobot(context, place, scene, run, i, t, look) {
  const [x, y, yaw] = run.pose(i, t);
  const radius = look.hull * place.scale;
  context.save();
  context.translate(place.x(x), place.y(y));
  context.fillStyle = look.colours[i];
  context.strokeStyle = look.theme.hull;
  context.lineWidth = 1;
  context.beginPath();
  context.arc(0, 0, radius, 0, 2 * Math.PI);
  context.fill();
  context.stroke();
  if (run.touches(i, t)) {
    context.strokeStyle = look.theme.touch;
    context.lineWidth = 3;
    context.beginPath();
    context.arc(0, 0, radius + 2, 0, 2 * Math.PI);
    context.stroke();
  }
  drawHeading(context, radius, yaw);
  if (radius >= 8) drawNumber(context, radius, i + 1);
  else if (look.chosen === i) drawNumber(context, 14, i + 1, -radius - 9);
  context.restore();
}

/** An arrowhead inside the rim; of a small robot, a line from its middle to the rim. */
function drawHeading(context, radius, yaw) {
  const at = (share, bearing) =>
    [share * radius * Math.cos(yaw + bearing), -share * radius * Math.sin(yaw + bearing)];
  context.fillStyle = context.strokeStyle = "#ffffff";
  context.beginPath();
  if (radius < 8) {
    context.lineWidth = Math.max(1, radius / 4);
    context.moveTo(0, 0);
    context.lineTo(...at(1, 0));
    context.stroke();
    return;
  }
  context.moveTo(...at(1, 0));
  context.lineTo(...at(0.74, 0.62));
  context.lineTo(...at(0.74, -0.62));
  context.fill();
}

function drawNumber(context, radius, number, y = 0.5) {
  context.font = `600 ${Math.max(9, Math.round(0.8 * radius))}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 2.5;
  context.lineJoin = "round";
  context.strokeStyle = "rgba(0, 0, 0, .55)";
  context.strokeText(number, 0, y);
  context.fillStyle = "#ffffff";
  context.fillText(number, 0, y);
}

// The charts

const CHART = { left: 50, right: 14, top: 24, gap: 46, bottom: 40 }; // px

/** Where the two plots of a chart lie, and where time and values lie in them. */
function placeCharts(width, height, last, ranges) {
  const plot = (height - CHART.top - CHART.gap - CHART.bottom) / 2;
  const across = width - CHART.left - CHART.right;
  return {
    x: (t) => CHART.left + across * t / Math.max(1, last),
    frame: (x) => Math.round(last * (x - CHART.left) / across),
    plots: ranges.map(([low, high], row) => {
      const top = CHART.top + row * (plot + CHART.gap);
      return { low, high, top, bottom: top + plot,
        y: (value) => top + plot * (high - value) / (high - low) };
    }),
  };
}

/** Round numbers from low to high, some `count` of them. */
function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high * (1 + 1e-9); n++) {
    found.push(Number((n * step).toPrecision(6)));
  }
  return found;
}

/** The range of both plots, over all runs of an episode. */
function chartRanges(runs) {
  const span = (value, floor) => {
    let [low, high] = [0, floor];
    for (const run of runs) {
      for (let i = 0; i < run.robots; i++) {
        for (let t = 0; t <= run.last; t++) {
          const now = value(run, i, t);
          low = Math.min(low, now);
          high = Math.max(high, now);
        }
      }
    }
    const spare = 0.04 * (high - low);
    return [low < 0 ? low - spare : low, high + spare];
  };
  return [
    span((run, i, t) => run.distance(i, t), 0.1),
    span((run, i, t) => run.reward(i, t), 0.1),
  ];
}

/** Draws everything of a chart that does not move, once, on a canvas that is not shown. */
function drawCharts(canvas, run, last, ranges, look) {
  const layer = document.createElement("canvas");
  layer.width = canvas.width;
  layer.height = canvas.height;
  const context = layer.getContext("2d");
  const ratio = window.devicePixelRatio || 1;
  context.scale(ratio, ratio);
  const place = placeCharts(canvas.clientWidth, canvas.clientHeight, last, ranges);
  const titles = ["distance to target (m)", "reward so far"];
  place.plots.forEach((plot, row) =>
    drawAxes(context, place, plot, titles[row], canvas.clientWidth, last, look));
  const values = [run.distance, run.reward];
  for (let i = 0; i < run.robots; i++) {
    place.plots.forEach((plot, row) => drawCurve(context, place, plot, run, i, values[row], look));
    drawEvents(context, place, run, i, look);
  }
  context.fillStyle = look.theme.ink;
  context.textAlign = "right";
  context.textBaseline = "bottom";
  context.fillText("time (s)", canvas.clientWidth - CHART.right, canvas.clientHeight - 3);
  return layer;
}

function drawAxes(context, place, plot, title, width, last, look) {
  const { theme } = look;
  context.font = "12px system-ui, sans-serif";
  context.lineWidth = 1;
  context.textBaseline = "middle";
  context.textAlign = "right";
  for (const value of ticks(plot.low, plot.high, (plot.bottom - plot.top) / 30)) {
    context.strokeStyle = value === 0 ? theme.line : theme.grid;
    context.beginPath();
    context.moveTo(CHART.left, plot.y(value));
    context.lineTo(width - CHART.right, plot.y(value));
    context.stroke();
    context.fillStyle = theme.soft;
    context.fillText(value, CHART.left - 6, plot.y(value));
  }
  context.textBaseline = "top";
  context.textAlign = "center";
  const spaces = Math.max(2, Math.floor((width - CHART.left) / 80));
  for (const time of ticks(0, last * look.step, spaces)) {
    context.fillText(time, place.x(time / look.step), plot.bottom + 5);
  }
  context.textAlign = "left";
  context.textBaseline = "bottom";
  context.fillStyle = theme.ink;
  context.fillText(title, CHART.left, plot.top - 5);
}

function drawCurve(context, place, plot, run, i, value, look) {
  context.globalAlpha = look.chosen === null ? 0.9 : look.chosen === i ? 1 : 0.15;
  context.strokeStyle = look.colours[i];
  context.lineWidth = look.chosen === i ? 2.5 : run.robots <= FEW ? 1.6 : 1;
  context.beginPath();
  for (let t = 0; t <= run.last; t++) context.lineTo(place.x(t), plot.y(value(i, t)));
  context.stroke();
  context.globalAlpha = 1;
}

/** Arrivals as dots and contacts as crosses, on the curve of the distance. */
function drawEvents(context, place, run, i, look) {
  if (look.chosen !== null && look.chosen !== i) return;
  const [plot] = place.plots;
  const arrival = run.arrival(i);
  if (arrival) {
    context.fillStyle = look.colours[i];
    context.beginPath();
    context.arc(place.x(arrival), plot.y(run.distance(i, arrival)), 3.5, 0, 2 * Math.PI);
    context.fill();
  }
  const total = (t) => run.contacts(i, t).reduce((sum, count) => sum + count, 0);
  context.strokeStyle = look.theme.touch;
  context.lineWidth = 1.8;
  context.beginPath();
  for (let t = 1; t <= run.last; t++) {
    if (total(t) === total(t - 1)) continue;
    const [x, y] = [place.x(t), plot.y(run.distance(i, t))];
    context.moveTo(x - 3.5, y - 3.5);
    context.lineTo(x + 3.5, y + 3.5);
    context.moveTo(x - 3.5, y + 3.5);
    context.lineTo(x + 3.5, y - 3.5);
  }
  context.stroke();
}

/** Draws a chart: what stands still in it, and the cursor at frame t. */
function drawCursor(canvas, layer, run, t, last, ranges, look) {
  const { context, width, height } = fit(canvas);
  context.drawImage(layer, 0, 0, width, height);
  const place = placeCharts(width, height, last, ranges);
  context.strokeStyle = look.theme.ink;
  context.lineWidth = 1;
  for (const plot of place.plots) {
    context.beginPath();
    context.moveTo(place.x(t), plot.top);
    context.lineTo(place.x(t), plot.bottom);
    context.stroke();
  }
  const values = [run.distance, run.reward];
  for (let i = 0; i < run.robots; i++) {
    if (look.chosen === null ? run.robots > FEW : look.chosen !== i) continue;
    context.fillStyle = look.colours[i];
    place.plots.forEach((plot, row) => {
      context.beginPath();
      context.arc(place.x(t), plot.y(values[row](i, t)), 3.5, 0, 2 * Math.PI);
      context.fill();
    });
  }
}

/** Writes a number with at most so many digits after the point. */
function round(value, digits) {
  return String(Number(value.toFixed(digits)));
}
