/*
 * Drawing the tasks of world.js: the arena with its drones, and one value for each action. The words for numbers, too.
 *
 * The page gives the colours, as the CSS properties --fg, --bg, --muted, --accent and --obstacle.
 */

const COLOURS = ["fg", "bg", "muted", "accent", "obstacle"];
const CIVIDIS = [
  [0, 34, 77], [26, 56, 111], [67, 78, 107], [97, 100, 111], [124, 123, 120],
  [155, 147, 118], [187, 173, 108], [222, 201, 87], [253, 231, 55],
]; // dark to bright evenly, to any colour vision

/** A number to so many decimals, with a minus as in print. */
function fixed(number, decimals) {
  return number.toFixed(decimals).replace(/^-(0(\.0*)?)$/, "$1").replace("-", "\u2212");
}

/** A number to three digits; what is next to nothing is told as such. */
function short(number) {
  if (number !== 0 && Math.abs(number) < 0.0005) return number > 0 ? "< 0.001" : "> \u22120.001";
  return String(Number(number.toPrecision(3))).replace("-", "\u2212");
}

/** An action: [degrees, px], or of a box [yaw, pitch, px]. */
function inWords(action) {
  const [degrees, pixels, pitch] = [action[0], action.at(-1), pitchOf(action)];
  const turn = degrees === 0 ? "no turn" : `turn ${Math.abs(degrees)}° ${degrees > 0 ? "left" : "right"}`;
  const tilt = pitch === 0 ? "" : `, nose ${Math.abs(pitch)}° ${pitch > 0 ? "up" : "down"}`;
  return `${turn}${tilt}, ${pixels === 0 ? "stay" : `fly ${pixels} px`}`;
}

function pitchOf(action) {
  return action.length > 2 ? action[1] : 0;
}

const STEPS_PER_SECOND = 30; // at speed 1
const LONGEST_PAUSE = 0.1; // [s] between two pictures; after a longer one (a hidden page) play goes on, and does not jump

/** Call `picture` with the seconds since the last one, at each picture while `owner` plays; one loop at a time. */
function everyPicture(owner, picture) {
  let before = performance.now();
  const turn = (owner.turn = {});
  const tick = (now) => {
    if (!owner.playing || owner.turn !== turn) return;
    const passed = clamp((now - before) / 1000, 0, LONGEST_PAUSE); // a tick may lie before the click
    before = now;
    picture(passed);
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}

/** Have `draw` called when a canvas in an element has another size, and `recolour` now and when the colours change. */
function watchLooks(element, draw, recolour) {
  const sizes = new ResizeObserver(draw);
  for (const canvas of element.querySelectorAll("canvas")) sizes.observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
  recolour();
}

/** The page's colours as they are now, by their names, each as a canvas understands it. */
function readColours(element, names = COLOURS) {
  const probe = element.appendChild(document.createElement("span"));
  const found = {};
  for (const name of names) {
    probe.style.color = `var(--${name})`; // resolves what a property's own text may not: var(), light-dark()
    found[name] = getComputedStyle(probe).color;
  }
  probe.remove();
  return found;
}

/** Black or white, whichever is read more easily on a colour: "#rrggbb" or "rgb(r, g, b)". */
function inkOn(colour) {
  const hex = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  const [red, green, blue] = (colour[0] === "#" ? hex : colour.match(/\d+/g)).map((part) => (part / 255) ** 2.2);
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.18 ? "#000000" : "#ffffff";
}

/** Fit a canvas to its place on the screen, sharp on any; its context, cleared, in CSS px, and its size. */
function fit(canvas) {
  const sharpness = window.devicePixelRatio || 1;
  const { width, height } = canvas.getBoundingClientRect();
  const size = [width, height].map((side) => Math.max(1, Math.round(side * sharpness)));
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  const context = canvas.getContext("2d");
  context.setTransform(sharpness, 0, 0, sharpness, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

function disc(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}

function ring(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.stroke();
}

function line(context, points, width, colour) {
  context.beginPath();
  points.forEach(([x, y], place) => (place ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.lineWidth = width;
  context.strokeStyle = colour;
  context.stroke();
}

function drawBorder(context, world, colours) {
  const { width, height, border } = world;
  const gap = 1; // [px] between two squares, so that they are seen as such
  context.fillStyle = colours.muted;
  for (let x = 0; x < width; x += border) {
    for (let y = 0; y < height; y += border) {
      const inside = x > 0 && x < width - border && y > 0 && y < height - border;
      if (!inside) context.fillRect(x + gap / 2, y + gap / 2, border - gap, border - gap);
    }
  }
}

function drawSensor(context, world, { x, y, angle }, colours) {
  const half = (world.sensor_arc / 360) * Math.PI;
  context.beginPath();
  context.moveTo(x, y);
  context.arc(x, y, world.sensor_radius, angle - half, angle + half);
  context.closePath();
  context.fillStyle = context.strokeStyle = colours.accent;
  context.globalAlpha = 0.15;
  context.fill();
  context.globalAlpha = 0.6;
  context.lineWidth = 1;
  context.stroke();
  context.globalAlpha = 1;
}

/**
 * A drone: a disc in its colour with a line towards its heading, the shorter the less of it is in the plane; after a
 * collision a faint disc and a cross.
 */
function drawDrone(context, world, { x, y, angle, reach = 1 }, crashed, thick, colours) {
  const radius = world.drone_radius;
  const at = (turn, share) => [x + share * radius * Math.cos(angle + turn), y + share * radius * Math.sin(angle + turn)];
  context.fillStyle = colours.accent;
  context.globalAlpha = crashed ? 0.35 : 1;
  disc(context, x, y, radius);
  context.globalAlpha = 1;
  if (crashed) {
    for (const turn of [Math.PI / 4, (3 * Math.PI) / 4]) line(context, [at(turn, 1), at(turn + Math.PI, 1)], 4 * thick, colours.accent);
    return;
  }
  line(context, [[x, y], at(0, reach)], 4, colours.ink);
}

const SHADES = 8; // of a trail that fades

/** A trail that is the fainter, the longer ago. */
function drawFading(context, trail, width, colour) {
  context.lineCap = "butt"; // round ends would lie over one another
  for (let shade = 0; shade < SHADES; shade += 1) {
    const [first, last] = [shade, shade + 1].map((one) => Math.floor((one * (trail.length - 1)) / SHADES));
    context.globalAlpha = (shade + 1) / SHADES;
    line(context, trail.slice(first, last + 1), width, colour);
  }
  context.globalAlpha = 1;
  context.lineCap = "round";
}

/** A rim around a drone, and its sign behind its line, upright whatever the drone's heading. */
function drawSign(context, world, { x, y, angle }, sign, colours) {
  context.lineWidth = 2;
  context.strokeStyle = colours.fg;
  ring(context, x, y, world.drone_radius);
  context.save();
  context.translate(x - 0.42 * world.drone_radius * Math.cos(angle), y - 0.42 * world.drone_radius * Math.sin(angle));
  context.scale(1, -1);
  context.fillStyle = colours.ink;
  context.font = `700 ${0.8 * world.drone_radius}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(sign, 0, 0);
  context.restore();
}

const AHEAD = 12; // [steps] that the line of a moving circle shows

/** Where a circle that moves will be soon: a line from its centre. */
function drawDrift(context, [x, y, , vx, vy], thick, colours) {
  line(context, [[x, y], [x + AHEAD * vx, y + AHEAD * vy]], 2 * thick, colours.muted);
  context.fillStyle = colours.muted;
  disc(context, x, y, 3 * thick);
}

/** A goal: the ring within which it is reached, and a mark in its middle. */
function drawGoal(context, world, [x, y], thick, colours) {
  context.strokeStyle = context.fillStyle = colours.fg;
  context.lineWidth = 3 * thick;
  for (const radius of [world.goal_radius, world.goal_radius / 2]) ring(context, x, y, radius);
  disc(context, x, y, world.goal_radius / 6);
}

/** A drone with its sensor, its trail and what it senses: see drawArena. */
function drawFlight(context, world, drone, thick, given) {
  const { pose, trail, sensed, crashed, sign, faint, fades, accent = given.accent, ink = given.bg } = drone;
  const colours = { ...given, accent, ink };
  if (!faint && !crashed) drawSensor(context, world, pose, colours);
  (fades ? drawFading : line)(context, trail, (faint ? 2 : 2.5) * thick, colours.accent);
  for (const point of sensed) line(context, [[pose.x, pose.y], point], 1.5 * thick, colours.fg);
  drawDrone(context, world, pose, crashed, thick, colours);
  if (sign && !crashed) drawSign(context, world, pose, sign, colours);
  context.fillStyle = colours.fg;
  for (const point of sensed) disc(context, ...point, 5 * thick);
}

/**
 * The arena from above, its circles and its drones in their order.
 *
 * A circle is [x, y, radius], with [vx, vy] if it moves; the goal [x, y], if there is one.
 * Each drone has a pose { x, y, angle [radians] }, the trail [x, y] that it flew, and the points that it senses; perhaps
 * `crashed`, `sign` (a character), `accent` (its colour) and `ink` (on it), `faint` where its sensor is not to be shown,
 * and `fades` where its trail does.
 */
function drawArena(canvas, { world, circles, goal, drones, colours }) {
  const { context, width } = fit(canvas);
  const scale = width / world.width;
  context.fillStyle = colours.bg;
  context.fillRect(0, 0, width, scale * world.height);
  context.transform(scale, 0, 0, -scale, 0, scale * world.height); // the one place where y is flipped
  context.lineCap = context.lineJoin = "round";
  context.fillStyle = colours.obstacle;
  for (const [x, y, radius] of circles) disc(context, x, y, radius);
  drawBorder(context, world, colours);
  const thick = Math.max(1, 0.6 / scale); // lines must be seen on a small screen too
  for (const circle of circles) if (circle[3] || circle[4]) drawDrift(context, circle, thick, colours);
  if (goal) drawGoal(context, world, goal, thick, colours);
  for (const drone of drones) drawFlight(context, world, drone, thick, colours);
  return { context, thick };
}

function colourOf(share) {
  const place = Math.min(Math.max(share, 0), 1) * (CIVIDIS.length - 1);
  const low = Math.min(Math.floor(place), CIVIDIS.length - 2);
  const mix = CIVIDIS[low].map((part, index) => Math.round(part + (place - low) * (CIVIDIS[low + 1][index] - part)));
  return `rgb(${mix.join(" ")})`;
}

/** Where each action stands: left turns to the left, and the longer way the higher; of a box so in each pitch. */
function gridOf(actions) {
  const all = (part) => [...new Set(actions.map(part))].sort((a, b) => b - a);
  const [turns, ways, pitches] = [all((action) => action[0]), all((action) => action.at(-1)), all(pitchOf)];
  const rowOf = (action) => ways.length * pitches.indexOf(pitchOf(action)) + ways.indexOf(action.at(-1));
  const flat = pitches.length === 1;
  const marks = flat ? ways.map(String) : pitches.map((pitch) => fixed(pitch, 0));
  const title = flat ? "distance [px]" : `pitch [°], in each ${ways.join(", ")} px`;
  const cells = actions.map((action) => [turns.indexOf(action[0]), rowOf(action)]);
  return { turns, rows: ways.length * pitches.length, marks, title, cells };
}

function signed(degrees) {
  return degrees === 0 ? "0" : `${Math.abs(degrees)}°`;
}

function drawAxes(context, grid, { left, top, side }, colours) {
  const [across, down] = [side / grid.turns.length, side / grid.marks.length];
  context.fillStyle = colours.fg;
  context.textBaseline = "middle";
  context.textAlign = "center";
  grid.turns.forEach((turn, place) => context.fillText(signed(turn), left + (place + 0.5) * across, top + side + 11));
  context.textAlign = "right";
  grid.marks.forEach((mark, place) => context.fillText(mark, left - 6, top + (place + 0.5) * down));
  context.textAlign = "left";
  context.fillText("← turn left", left, top + side + 29);
  context.textAlign = "right";
  context.fillText("turn right →", left + side, top + side + 29);
  context.save();
  context.translate(9, top + side / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(grid.title, 0, 0);
  context.restore();
}

function drawLegend(context, { low, high }, { left, top, side }, colours) {
  const [bar, y] = [12, top + side + 48];
  const gradient = context.createLinearGradient(left, 0, left + side, 0);
  CIVIDIS.forEach((_, place) => {
    const share = place / (CIVIDIS.length - 1);
    gradient.addColorStop(share, colourOf(share));
  });
  context.fillStyle = gradient;
  context.fillRect(left, y, side, bar);
  context.strokeStyle = colours.muted;
  context.lineWidth = 1;
  context.strokeRect(left, y, side, bar);
  context.fillStyle = colours.fg;
  context.textAlign = "left";
  context.fillText(short(low), left, y + bar + 11);
  context.textAlign = "right";
  context.fillText(short(high), left + side, y + bar + 11);
}

/** Two frames, a dark and a bright one, so that one of them is seen on any colour. */
function outline(context, x, y, width, height) {
  for (const [inset, colour] of [[0, "#000"], [2, "#fff"]]) {
    context.lineWidth = 2;
    context.strokeStyle = colour;
    context.strokeRect(x + inset, y + inset, width - 2 * inset, height - 2 * inset);
  }
}

/**
 * One square an action, the chosen one framed: `shares` of the way from the value `low` to `high`. Without shares it has
 * the words that `instead` gives.
 */
function drawValues(canvas, { grid, colours, font, instead, shares, chosen, low, high }) {
  const { context, width } = fit(canvas);
  const place = { left: 36, top: 4, side: width - 40 };
  const [across, down] = [place.side / grid.turns.length, place.side / grid.rows];
  context.font = font;
  drawAxes(context, grid, place, colours);
  context.lineWidth = 1;
  context.strokeStyle = colours.muted;
  context.strokeRect(place.left, place.top, place.side, place.side);
  const corner = ([column, row]) => [place.left + column * across, place.top + row * down];
  if (shares) {
    const gap = 1; // [px] between two actions, so that alike ones can be counted
    grid.cells.forEach((cell, action) => {
      context.fillStyle = colourOf(shares(action));
      const [x, y] = corner(cell);
      context.fillRect(x + gap / 2, y + gap / 2, across - gap, down - gap);
    });
    drawLegend(context, { low, high }, place, colours);
  } else {
    context.textAlign = "center";
    context.fillStyle = colours.muted;
    context.fillText(instead, place.left + place.side / 2, place.top + place.side / 2);
  }
  if (chosen !== undefined) outline(context, ...corner(grid.cells[chosen]), across, down);
}
