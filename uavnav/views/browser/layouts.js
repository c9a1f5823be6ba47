/*
 * Layouts, drawn as uavnav/tasks/{circles,slalom,moving,goal}.py draw them, from other random numbers. Each
 * is a function of its seed. `needs` are uavnav/views/browser/__init__.py's.
 */

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

/** Distance [px] from a place to the edge of a circle, negative inside. */
function toEdge([atX, atY], [x, y, radius]) {
  return Math.hypot(x - atX, y - atY) - radius;
}

/**
 * k circles of uniform radius and centre, drawn again until the start is free: sec. 4.1. Of one seed, more
 * circles begin with the same ones.
 */
function generate(world, k, seed) {
  const draw = randomNumbers(seed);
  const start = [world.width / 2, world.height / 2];
  const span = world.obstacle_radius_max - world.obstacle_radius_min;
  return Array.from({ length: k }, () => {
    const radius = f32(world.obstacle_radius_min + span * draw());
    let circle;
    do circle = [f32(world.width * draw()), f32(world.height * draw()), radius];
    while (toEdge(start, circle) < world.safe_zone);
    return circle;
  });
}

/** So many normal numbers, two uniform ones each (Box and Muller). */
function normalNumbers(count, draw) {
  const normal = () => Math.sqrt(-2 * Math.log(1 - draw())) * Math.cos(2 * Math.PI * draw());
  return Array.from({ length: count }, normal);
}

/** Four columns of circles, each with a gap of so many px whose middle is uniform: uavnav/tasks/slalom.py. */
function generateSlalom({ columns, radius, spacing, height }, gap, seed) {
  const draw = randomNumbers(seed);
  const margin = spacing + gap / 2;
  return columns.flatMap((x) => {
    const middle = margin + (height - 2 * margin) * draw();
    const [bottom, top] = [middle - gap / 2, middle + gap / 2];
    const places = Array.from({ length: height / spacing + 1 }, (_, nth) => nth * spacing);
    const below = places.filter((y) => y + radius <= bottom).with(-1, bottom - radius);
    const above = places.filter((y) => y - radius >= top).with(0, top + radius);
    return [...below, ...above].map((y) => [x, f32(y), radius]);
  });
}

/** Velocities for circles, the same directions whatever the speeds: uniform between two [px a step]. */
function withVelocities(circles, low, high, seed) {
  const draw = randomNumbers(seed ^ 0x5bd1e995);
  return circles.map((circle) => {
    const [speed, angle] = [low + (high - low) * draw(), 2 * Math.PI * draw()];
    return [...circle, f32(speed * Math.cos(angle)), f32(speed * Math.sin(angle))];
  });
}

/** The places of a grid that the drone can reach from the start: [x, y] px. */
function reachable(world, circles, grid) {
  const found = new Map();
  const waiting = [[world.width / 2, world.height / 2]];
  for (const [x, y] of waiting) {
    const isFree = roomAt(world, circles, x, y) > world.drone_radius; // so never beyond the border
    if (!isFree || found.has(`${x} ${y}`)) continue;
    found.set(`${x} ${y}`, [x, y]);
    waiting.push([x - grid, y], [x + grid, y], [x, y - grid], [x, y + grid]);
  }
  return [...found.values()];
}

/** Distance [px] from a place to the nearest edge of circles or of the border. */
function roomAt({ width, height, border }, circles, x, y) {
  const edges = circles.map((circle) => toEdge([x, y], circle));
  return Math.min(x - border, width - border - x, y - border, height - border - y, ...edges);
}

const LAYOUTS_TRIED = 20; // without a goal, before a circle is left out

/** Circles and a goal that can be reached, uniform where there is room: { circles, goal }, as goal.py. */
function generateGoal(world, needs, k, seed) {
  const { room, far, tries, grid } = needs;
  const draw = randomNumbers(seed ^ 0x2c1b3c6d);
  let circles = generate(world, k, seed);
  for (let tried = 1; ; tried += 1) {
    const places = reachable(world, circles, grid);
    for (let goals = 0; goals < tries; goals += 1) {
      const goal = [f32(world.width * draw()), f32(world.height * draw())];
      const away = ([x, y]) => Math.hypot(goal[0] - x, goal[1] - y);
      const isFar = away([world.width / 2, world.height / 2]) >= far;
      const isFree = isFar && roomAt(world, circles, ...goal) >= room;
      if (isFree && places.some((place) => away(place) <= world.goal_radius)) return { circles, goal };
    }
    const fewer = Math.max(0, k - Math.floor(tried / LAYOUTS_TRIED));
    circles = generate(world, fewer, Math.floor(2 ** 32 * draw()));
  }
}
