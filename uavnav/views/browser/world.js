"use strict";

/*
 * The tasks of uavnav/tasks, for one drone, in plain numbers: how it starts, what it senses, how an action
 * moves it, what a step earns and ends. Nothing here draws, and nothing keeps a state.
 *
 * A page gives the constants of a task as uavnav/views/browser/__init__.py has them. A circle is [x, y,
 * radius] px; one that moves has [vx, vy] px a step more. A layout is { circles, goal }, the goal [x, y] px
 * or none. A state has x, y [px], heading [whole degrees] and an episode's counts. Math.fround is where
 * Python has float32.
 */

const f32 = Math.fround;
const VIEW_TOLERANCE = 1e-6; // so that rounding never hides a neighbour that is exactly at the drone's side
const COSINES = Float32Array.from({ length: 360 }, (_, degrees) => exactCosine(degrees));
const SINES = Float32Array.from({ length: 360 }, (_, degrees) => exactCosine(degrees - 90));

function radians(degrees) { return (degrees * Math.PI) / 180; }

function exactCosine(degrees) {
  return { 0: 1, 90: 0, 180: -1, 270: 0 }[(degrees + 360) % 360] ?? Math.cos(radians(degrees));
}

function clamp(value, low, high) { return Math.min(Math.max(value, low), high); }

/** An action's turn [degrees, left positive] and distance [px]: eqs (11) and (12). */
function decode(world, action) {
  const turn = Math.floor(action / world.n_distances);
  return [turn <= furthestTurns(world)[1] ? turn : turn - world.n_turns, action % world.n_distances];
}

/** The turn and the distance of each action. */
function actionsOf(world) {
  return Array.from({ length: world.n_turns * world.n_distances }, (_, action) => decode(world, action));
}

/** The furthest turns of an action [degrees, left positive]: to the right, and to the left. */
function furthestTurns(world) {
  const left = Math.floor(world.n_turns / 2);
  return [left + 1 - world.n_turns, left];
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

/** Offset from a place to the nearest point of [first, first + side]; zero inside. */
function toInterval(place, first, side) {
  return f32(clamp(place, first, first + side) - place);
}

/** Offsets [dx, dy] to the nearest points of the border's squares: those of two rows, then of two columns. */
function toSquares({ width, height, border }, x, y) {
  const along = (place, first, count) =>
    Array.from({ length: count }, (_, nth) => toInterval(place, first + nth * border, border));
  const across = (place, size) => [0, size - border].map((first) => toInterval(place, first, border));
  const [lefts, bottoms] = [along(x, 0, width / border), along(y, border, height / border - 2)];
  const rows = across(y, height).flatMap((dy) => lefts.map((dx) => [dx, dy]));
  const columns = across(x, width).flatMap((dx) => bottoms.map((dy) => [dx, dy]));
  return [...rows, ...columns];
}

function lengthOf(dx, dy) { return f32(Math.sqrt(f32(f32(dx * dx) + f32(dy * dy)))); }

/** The direction of an offset of some length, as a drone of a heading sees it: [right, forward]. */
function direction([dx, dy, length], heading) {
  const scale = length > 0 ? f32(1 / length) : 0; // a centre that coincides has no direction
  const [ux, uy, cosine, sine] = [f32(dx * scale), f32(dy * scale), COSINES[heading], SINES[heading]];
  return [f32(f32(ux * sine) - f32(uy * cosine)), f32(f32(ux * cosine) + f32(uy * sine))];
}

/**
 * The ten nearest obstacles in view, eqs (9), (10) and (13), nearest first, ties in index order; and the
 * clearance: the distance [px] to the nearest of all, in view or not.
 * -> { observation: Float32Array(30), clearance }
 *
 * echoes: what faults make of a filled slot, of its place and distance [px]: a distance, or
 * undefined if it is lost.
 */
function sense(world, { x, y, heading }, circles, echoes = (slot, distance) => distance) {
  const around = circles.map(([cx, cy, radius]) => [f32(cx - x), f32(cy - y), radius]);
  const offsets = [...around, ...toSquares(world, x, y)]; // a square has no radius
  const least = f32(Math.cos(radians(world.sensor_arc / 2)) - VIEW_TOLERANCE);
  const span = world.sensor_radius - world.drone_radius;
  let clearance = Infinity;
  const seen = [];
  for (const [dx, dy, radius = 0] of offsets) {
    const length = lengthOf(dx, dy);
    const distance = f32(length - radius);
    clearance = Math.min(clearance, distance);
    if (distance > world.sensor_radius) continue;
    const [right, forward] = direction([dx, dy, length], heading);
    if (forward < least) continue;
    seen.push({ distance, direction: [clamp(right, -1, 1), clamp(forward, 0, 1)] });
  }
  seen.sort((one, other) => one.distance - other.distance); // stable
  const observation = new Float32Array(3 * world.n_slots);
  for (let slot = 0; slot < world.n_slots; slot += 1) {
    const sensed = seen[slot] && echoes(slot, seen[slot].distance);
    const proximity = clamp(f32(f32(sensed - world.drone_radius) / span), 0, 1);
    const numbers = sensed === undefined ? [0, 0, 1] : [...seen[slot].direction, proximity];
    observation.set(numbers, 3 * slot);
  }
  return { observation, clearance };
}

/** A drone's right and forward in the world, each [x, y]: of a heading [radians]. */
function planeAxes(angle) {
  const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
  return [[sine, -cosine], [cosine, sine]];
}

/**
 * The points that the slots of an observation name, as the place has them: eqs (9), (10) and (13) backwards.
 *
 * axes: the drone's own in the world; slots: a part along each of them, then the proximity.
 */
function sensedPoints(world, place, axes, slots) {
  return slots.filter(isFilled).map((slot) => {
    const reach = world.drone_radius + slot.at(-1) * (world.sensor_radius - world.drone_radius);
    const ahead = (axis) => axes.reduce((sum, own, part) => sum + slot[part] * own[axis], 0);
    return place.map((at, axis) => at + reach * ahead(axis));
  });
}

/** Whether a slot has a direction: an empty one has none, nor has one of what is at the drone's own place. */
function isFilled(slot) { return slot.slice(0, -1).some(Boolean); }

/** The slots [right, forward, proximity] of an observation. */
function slotsOf(world, observation) {
  const slotAt = (_, slot) => [...observation.subarray(3 * slot, 3 * slot + 3)];
  return Array.from({ length: world.n_slots }, slotAt);
}

/** The way to the goal in an observation: right, forward and away [px]; undefined where none is sensed. */
function wayOf(world, observation, scale) {
  const [right, forward, away] = observation.subarray(3 * world.n_slots);
  return right === undefined ? undefined : [right, forward, away * scale];
}

const NO_FAULTS = { noise: 0, lost: 0, late: 0, sticky: 0 }; // [px], probability, [steps], probability

/** How many random numbers a step needs: normal ones for noise, uniform ones for lost echoes and sticking. */
function drawsOf(world, { noise, lost, sticky }) {
  return [noise > 0 ? world.n_slots : 0, lost > 0 ? world.n_slots : 0, Number(sticky > 0)];
}

/** What faults make of echoes, as `sense` asks; draws: of one step. */
function echoesOf(world, faults, draws) {
  const [normal] = drawsOf(world, faults);
  return (slot, distance) => {
    if (faults.lost && draws[normal + slot] < faults.lost) return undefined;
    return faults.noise ? f32(distance + f32(faults.noise * draws[slot])) : distance;
  };
}

/** The reward of a step: eq. (14), exclusive cases. */
function reward(world, degrees, pixels, collided) {
  if (collided) return world.collision_reward;
  return pixels === 0 || degrees !== 0 ? world.penalty : world.reward_per_pixel * pixels;
}

/** A metric of sec. 4.3 as uavnav/runs/metrics.py has it: the episode's count, or its share of the steps. */
function metricOf({ column, scale }, state) {
  if (scale === null) return state[column];
  return state.steps ? (scale * state[column]) / state.steps : 0;
}

/** Where a number is that goes from `place` at `speed`, bouncing between 0 and `size`, and its speed then. */
function reflect(place, speed, steps, size) {
  const way = place + speed * steps;
  const rest = way - 2 * size * Math.round(way / (2 * size)); // [-size, size]: the wave is its magnitude
  const onwards = speed > 0 ? rest >= 0 && rest < size : rest > 0 || rest <= -size;
  return [f32(Math.abs(rest)), onwards ? speed : -speed];
}

/** The paper's task. Another one is a class that says what differs; who flies or draws asks only a task. */
class Task {
  moves = false; // whether obstacles do

  /** given: constants of the task (`world`, `max_steps`, `needs` of its layouts); faults: as NO_FAULTS. */
  constructor({ world, max_steps, needs }, faults = NO_FAULTS) {
    Object.assign(this, { world, max_steps, needs, faults });
    this.remembers = Object.values(faults).some((fault) => fault > 0);
  }

  /** The random layout of a number, with k circles or gaps of so many px: the parts of a scene. */
  generate({ k, layout }) { return { circles: generate(this.world, k, layout) }; }

  /** A layout with other circles [x, y, radius] in place of its own; seed: of what is drawn for them. */
  arrange(layout, circles, seed) { return { ...layout, circles }; }

  /** Where the circles of a layout are after so many steps. */
  obstacles(layout, steps) { return layout.circles; }

  /** How many numbers a policy sees. */
  get observationSize() { return 3 * this.world.n_slots; }

  /** The random numbers that faults need to start, and in each step; draw: uniform ones. */
  draw(draw) {
    const [normal, lost, sticky] = drawsOf(this.world, this.faults);
    return [...normalNumbers(normal, draw), ...Array.from({ length: lost + sticky }, draw)];
  }

  /** Where an episode starts: the centre, heading up. draws: of `draw`, disturb what is sensed first. */
  start(layout, draws) {
    const counts = { steps: 0, stops: 0, full_stops: 0, turns: 0, distance: 0, reward: 0, waited: 0 };
    const { width, height } = this.world;
    return this.remember({ x: width / 2, y: height / 2, heading: 90, ...counts }, layout, draws);
  }

  /** The same state where only what is there now was ever sensed, if there are faults. */
  remember(state, layout, draws) {
    if (!this.remembers) return state;
    const seen = Array(this.faults.late + 1).fill(this.sense(state, layout, draws).observation);
    return { ...state, seen, executed: state.executed ?? 0 };
  }

  /** { observation, clearance } now; without draws, as they are. Circles move also while a drone waits. */
  sense(state, layout, draws) {
    const echoes = draws?.length ? echoesOf(this.world, this.faults, draws) : undefined;
    return sense(this.world, state, this.obstacles(layout, state.steps + state.waited), echoes);
  }

  /** What a policy sees, late where observations are. -> { observation, clearance } */
  observe(state, layout) {
    const { observation, clearance } = this.sense(state, layout);
    return { observation: this.remembers ? state.seen.at(-1) : observation, clearance };
  }

  /**
   * Move, sense, then judge.
   * -> { state, observation, clearance, ended: "", "collision", "goal" or "time-out" }
   */
  step(state, action, layout, draws) {
    const sticks = this.faults.sticky && state.steps > 0 && draws.at(-1) < this.faults.sticky;
    const executed = sticks ? state.executed : action;
    const [degrees, pixels] = decode(this.world, executed);
    const moved = { ...state, ...move(state, degrees, pixels), steps: state.steps + 1 };
    const { observation, clearance } = this.sense(moved, layout, draws);
    const collided = clearance <= this.world.drone_radius;
    const [arrived, earned] = this.judge(state, moved, { degrees, pixels, collided }, layout);
    const stopped = Number(pixels === 0);
    const after = {
      ...moved,
      stops: state.stops + stopped,
      full_stops: state.full_stops + stopped * Number(degrees === 0),
      turns: state.turns + Number(degrees !== 0),
      distance: state.distance + pixels,
      reward: state.reward + earned,
      ...(this.remembers ? { seen: [observation, ...state.seen.slice(0, -1)], executed } : {}),
    };
    const late = this.max_steps && after.steps >= this.max_steps ? "time-out" : "";
    const ended = collided ? "collision" : arrived ? "goal" : late;
    return { state: after, observation: this.remembers ? after.seen.at(-1) : observation, clearance, ended };
  }

  /** What circles leave free: [x, y, room], px from a place to every circle's edge. The start is one. */
  free(layout) {
    return [[this.world.width / 2, this.world.height / 2, this.world.safe_zone]];
  }

  /** Whether a step has reached a goal, and what it earns. */
  judge(before, after, { degrees, pixels, collided }) {
    return [false, reward(this.world, degrees, pixels, collided)];
  }
}

/** Four columns of circles, each with a gap. */
class Slalom extends Task {
  generate({ gap, layout }) {
    return { circles: generateSlalom(this.needs, gap, layout) };
  }
}

/** Circles that fly straight on and bounce off the window's edges: where they are follows from the step. */
class Moving extends Task {
  moves = true;

  generate({ k, layout }) {
    return this.arrange({}, generate(this.world, k, layout), layout);
  }

  arrange(layout, circles, seed) {
    return { ...layout, circles: withVelocities(circles, this.world.speed_min, this.world.speed_max, seed) };
  }

  /** Each as [x, y, radius, vx, vy] now. */
  obstacles(layout, steps) {
    return layout.circles.map(([x, y, radius, vx = 0, vy = 0]) => {
      const [nowX, nowVx] = reflect(x, vx, steps, this.world.width);
      const [nowY, nowVy] = reflect(y, vy, steps, this.world.height);
      return [nowX, nowY, radius, nowVx, nowVy];
    });
  }
}

/** A place to fly to among circles that stand still: an observation has three numbers more. */
class Goal extends Task {
  generate({ k, layout }) { return generateGoal(this.world, this.needs, k, layout); }

  get observationSize() { return super.observationSize + 3; }

  free(layout) { return [...super.free(layout), [...layout.goal, this.needs.room]]; }

  /** From a place to the goal: dx, dy and distance [px]. */
  toGoal({ x, y }, { goal }) {
    const [dx, dy] = [f32(goal[0] - x), f32(goal[1] - y)];
    return [dx, dy, lengthOf(dx, dy)];
  }

  /** The slots, then the goal's direction, right and forward, and its distance in 1,000 px, at most 1. */
  sense(state, layout, draws) {
    const { observation, clearance } = super.sense(state, layout, draws);
    const way = this.toGoal(state, layout);
    const parts = direction(way, state.heading).map((part) => clamp(part, -1, 1));
    const ahead = [...parts, Math.min(f32(way[2] / this.needs.scale), 1)];
    return { observation: Float32Array.from([...observation, ...ahead]), clearance };
  }

  /** The goal earns 10, a pixel nearer to it 0.01, a turn or a stop -0.01; a collision -10, nothing else. */
  judge(before, after, { degrees, pixels, collided }, layout) {
    const { world } = this;
    const [far, near] = [before, after].map((state) => this.toGoal(state, layout)[2]);
    const arrived = near <= world.goal_radius;
    if (collided) return [arrived, world.collision_reward];
    const penalty = pixels === 0 || degrees !== 0 ? world.penalty : 0;
    return [arrived, Number(arrived) * world.goal_reward + world.reward_per_pixel * (far - near) + penalty];
  }
}

const TASKS = { drone: Task, slalom: Slalom, moving: Moving, goal: Goal };
