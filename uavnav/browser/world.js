"use strict";

/*
 * The world of uavnav/tasks, for one drone, in plain numbers: how it starts, what it senses, how an action moves it, what
 * a step earns and ends. Nothing here draws, and nothing keeps a state.
 *
 * A page gives the constants, as uavnav/tasks/world.py has them, as `world`. A circle is [x, y, radius] px. A state holds
 * x, y [px], heading [whole degrees] and the counts of an episode. Math.fround is where Python has float32.
 */

const f32 = Math.fround;
const VIEW_TOLERANCE = 1e-6; // so that rounding never hides a neighbour that is exactly beside the drone
const COSINES = Float32Array.from({ length: 360 }, (_, degrees) => exactCosine(degrees));
const SINES = Float32Array.from({ length: 360 }, (_, degrees) => exactCosine(degrees - 90));

function exactCosine(degrees) {
  return { 0: 1, 90: 0, 180: -1, 270: 0 }[(degrees + 360) % 360] ?? Math.cos((degrees * Math.PI) / 180);
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

// ---------------------------------------------------------------------------------------------- how an action moves

/** An action's turn [degrees, left positive] and distance [px]: eqs (11) and (12). */
function decode(world, action) {
  const turn = Math.floor(action / world.n_distances);
  return [turn <= Math.floor(world.n_turns / 2) ? turn : turn - world.n_turns, action % world.n_distances];
}

/** The action of a turn and a distance: `decode` backwards. */
function encode(world, [degrees, pixels]) {
  return (degrees < 0 ? degrees + world.n_turns : degrees) * world.n_distances + pixels;
}

/** Turn first, then fly straight along the new heading. */
function move(pose, degrees, pixels) {
  const heading = (pose.heading + degrees + 360) % 360;
  const x = f32(pose.x + f32(pixels * COSINES[heading]));
  const y = f32(pose.y + f32(pixels * SINES[heading]));
  return { x, y, heading };
}

// ---------------------------------------------------------------------------------------------- what it senses

/** Offset from a place to the nearest point of [first, first + side]; zero inside. */
function toInterval(place, first, side) {
  return f32(clamp(place, first, first + side) - place);
}

/** Lower ends of the squares of a wall that can be in view, or nearest, from a place along it. */
function squaresNear(world, place, lowest, highest) {
  const each = Math.ceil(world.sensor_radius / world.border); // so many a sensor can reach to either side
  const count = 2 * each + 2;
  const first = clamp(Math.ceil(f32(place / world.border)) - 1 - each, lowest, highest - count);
  return Array.from({ length: count }, (_, nth) => (first + nth) * world.border);
}

/** Offsets [dx, dy] to the nearest points of the border squares of the two nearer walls, in index order. */
function toSquares(world, x, y) {
  const { width, height, border } = world;
  const row = y < height / 2 ? 0 : height - border;
  const column = x < width / 2 ? 0 : width - border;
  const dy = toInterval(y, row, border);
  const dx = toInterval(x, column, border);
  const along = squaresNear(world, x, 0, width / border).map((left) => [toInterval(x, left, border), dy]);
  const up = squaresNear(world, y, 1, height / border - 1).map((bottom) => [dx, toInterval(y, bottom, border)]);
  return [...along, ...up];
}

function lengthOf(dx, dy) {
  return f32(Math.sqrt(f32(f32(dx * dx) + f32(dy * dy))));
}

/**
 * The ten nearest obstacles in view, eqs (9), (10) and (13), nearest first, ties in index order; and the clearance: the
 * distance [px] to the nearest of all, in view or not. -> { observation: Float32Array(30), clearance }
 */
function sense(world, { x, y, heading }, circles) {
  const found = []; // [distance, dx, dy, length]
  for (const [cx, cy, radius] of circles) {
    const [dx, dy] = [f32(cx - x), f32(cy - y)];
    const length = lengthOf(dx, dy);
    found.push([f32(length - radius), dx, dy, length]);
  }
  for (const [dx, dy] of toSquares(world, x, y)) {
    const length = lengthOf(dx, dy);
    found.push([length, dx, dy, length]);
  }
  const [cosine, sine] = [COSINES[heading], SINES[heading]];
  const least = f32(Math.cos((world.sensor_arc * Math.PI) / 360) - VIEW_TOLERANCE);
  const span = world.sensor_radius - world.drone_radius;
  let clearance = Infinity;
  const seen = [];
  for (const [distance, dx, dy, length] of found) {
    clearance = Math.min(clearance, distance);
    if (distance > world.sensor_radius) continue;
    const scale = length > 0 ? f32(1 / length) : 0; // a centre that coincides has no direction
    const [ux, uy] = [f32(dx * scale), f32(dy * scale)];
    const forward = f32(f32(ux * cosine) + f32(uy * sine));
    if (forward < least) continue;
    const right = f32(f32(ux * sine) - f32(uy * cosine));
    const proximity = f32(f32(distance - world.drone_radius) / span);
    seen.push({ distance, slot: [clamp(right, -1, 1), clamp(forward, 0, 1), clamp(proximity, 0, 1)] });
  }
  if (world.slots === "nearest") seen.sort((one, other) => one.distance - other.distance); // stable
  const observation = new Float32Array(3 * world.n_slots);
  for (let slot = 0; slot < world.n_slots; slot += 1) {
    observation.set(seen[slot]?.slot ?? [0, 0, world.padding === "far" ? 1 : 0], 3 * slot);
  }
  return { observation, clearance };
}

/** The points [x, y] that the slots of an observation name, in the world: eqs (9), (10) and (13) backwards. */
function sensedPoints(world, { x, y, angle }, slots) {
  const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
  const points = [];
  for (const [right, forward, proximity] of slots) {
    if (right === 0 && forward === 0) continue; // an empty slot
    const reach = world.drone_radius + proximity * (world.sensor_radius - world.drone_radius);
    points.push([x + reach * (right * sine + forward * cosine), y + reach * (forward * sine - right * cosine)]);
  }
  return points;
}

/** An observation as a list of slots [right, forward, proximity]. */
function slotsOf(observation) {
  return Array.from({ length: observation.length / 3 }, (_, slot) => [...observation.subarray(3 * slot, 3 * slot + 3)]);
}

// ---------------------------------------------------------------------------------------------- one step

/** Where an episode starts: the centre of the window, heading up. */
function start(world) {
  const counts = { steps: 0, stops: 0, full_stops: 0, turns: 0, distance: 0, reward: 0 };
  return { x: world.width / 2, y: world.height / 2, heading: 90, ...counts };
}

/** The reward of a step: eq. (14), exclusive cases. */
function reward(world, degrees, pixels, collided) {
  if (collided) return world.collision_reward;
  return pixels === 0 || degrees !== 0 ? world.penalty : world.reward_per_pixel * pixels;
}

/** Move, sense, then judge. -> { state, observation, clearance, collided } */
function step(world, state, action, circles) {
  const [degrees, pixels] = decode(world, action);
  const pose = move(state, degrees, pixels);
  const { observation, clearance } = sense(world, pose, circles);
  const collided = clearance <= world.drone_radius;
  const stopped = Number(pixels === 0);
  const after = {
    ...pose,
    steps: state.steps + 1,
    stops: state.stops + stopped,
    full_stops: state.full_stops + stopped * Number(degrees === 0),
    turns: state.turns + Number(degrees !== 0),
    distance: state.distance + pixels,
    reward: state.reward + reward(world, degrees, pixels, collided),
  };
  return { state: after, observation, clearance, collided };
}

/** A metric of sec. 4.3 as uavnav/runs/metrics.py has it: the episode's count, or its share of the steps. */
function metricOf({ column, scale }, state) {
  if (scale === null) return state[column];
  return state.steps ? (scale * state[column]) / state.steps : 0;
}

// ---------------------------------------------------------------------------------------------- sets of obstacles

/** Uniform numbers in [0, 1), the same for the same seed (mulberry32). */
function randomNumbers(seed) {
  let place = seed >>> 0;
  return () => {
    place = (place + 0x6d2b79f5) >>> 0;
    let mixed = Math.imul(place ^ (place >>> 15), place | 1);
    mixed ^= mixed + Math.imul(mixed ^ (mixed >>> 7), mixed | 61);
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 2 ** 32;
  };
}

/** Whether a circle leaves the start free: sec. 4.1. */
function isClear(world, [x, y, radius]) {
  return Math.hypot(x - world.width / 2, y - world.height / 2) - radius >= world.safe_zone;
}

/** k circles: radius and centre uniform, the centre drawn again until the start is free. More circles keep the first. */
function generate(world, k, seed) {
  const draw = randomNumbers(seed);
  const span = world.obstacle_radius_max - world.obstacle_radius_min;
  return Array.from({ length: k }, () => {
    const radius = f32(world.obstacle_radius_min + span * draw());
    let circle;
    do circle = [f32(world.width * draw()), f32(world.height * draw()), radius];
    while (!isClear(world, circle));
    return circle;
  });
}

/** The paper's task. Another world is another object with these functions; who flies or draws asks it alone. */
const PAPER = { start, sense, step, generate };
