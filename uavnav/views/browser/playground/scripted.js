/*
 * The scripted policies of uavnav/tasks/baselines.py and classics.py: functions of what is sensed.
 */

const MARGIN = 0.01; // [px] against rounding

/** Slots, each as { right, forward, distance [px] }. */
function echoesIn(world, observation) {
  const span = world.sensor_radius - world.drone_radius;
  return slotsOf(world, observation).map(([right, forward, proximity]) => {
    return { right, forward, distance: f32(world.drone_radius + f32(proximity * span)) };
  });
}

/** Those that have a direction. */
function bodiesIn(world, observation) {
  return echoesIn(world, observation).filter(({ right, forward }) => right || forward);
}

/** How much of [right, forward] lies in the direction of a turn [degrees, left positive]. */
function along({ right, forward }, degrees) {
  return forward * Math.cos(radians(degrees)) - right * Math.sin(radians(degrees));
}

/** The first bearing [degrees] that costs least; to the right where there is none. */
function cheapest(bearings, cost) {
  return bearings[best(bearings.map((bearing) => -cost(bearing)))] ?? -90;
}

/** Fly straight at full speed where that is certainly safe, else turn left on the spot. */
function reactive(world, observation) {
  const full = world.n_distances - 1;
  const safe = echoesIn(world, observation).every(
    ({ forward, distance }) => f32(distance - f32(full * forward)) > f32(world.drone_radius + MARGIN),
  );
  return encode(world, safe ? [0, full] : [furthestTurns(world)[1], 0]);
}

/** Turn to the free direction that is nearest to the goal's, and fly as far as is certainly safe. */
function towardsGoal(world, observation, { scale, bearings, look, spare }) {
  const [right, forward, away] = wayOf(world, observation, scale);
  const echoes = bodiesIn(world, observation);
  const reach = Math.min(away, look);
  const isFree = (bearing) =>
    echoes.every((echo) => {
      const closing = along(echo, -bearing);
      const passed = clamp(echo.distance * closing, 0, reach); // where it is nearest
      const nearest = Math.sqrt(echo.distance ** 2 - 2 * passed * echo.distance * closing + passed ** 2);
      return nearest > world.drone_radius + spare || closing <= 0;
    });
  const goal = Math.atan2(right, forward) / radians(1);
  const wanted = cheapest(bearings.filter(isFree), (bearing) => Math.abs(bearing - goal));
  const angle = clamp(-wanted, ...furthestTurns(world));
  const rooms = echoes.map((echo) => {
    const closing = along(echo, angle);
    return closing > 0 ? (echo.distance - world.drone_radius - MARGIN) / closing : Infinity;
  });
  const safe = Math.floor(clamp(Math.min(...rooms), 0, world.n_distances - 1));
  return encode(world, [angle, Math.abs(wanted) >= 45 ? 0 : safe]);
}

/** The first action of the way that keeps most clear of what is in view, also if that comes nearer itself. */
function dodge(world, observation, { ways, body, drift, enough }) {
  const centreOf = ({ right, forward, distance }) => [right, forward].map((part) => part * (distance + body));
  const centres = bodiesIn(world, observation).map(centreOf);
  const worths = ways.map(([places, , worth]) => {
    const clear = places.flatMap(([x, y], nth) => centres.map(([cx, cy]) => {
      const apart = Math.sqrt((x - cx) ** 2 + (y - cy) ** 2);
      return apart - body - world.drone_radius - drift * (nth + 1);
    }));
    return Math.min(enough, ...clear) + worth;
  });
  return ways[best(worths)][1];
}

const STRAIGHT_ON = [0, 1, Infinity]; // where to fly if no goal is sensed

/** The action whose displacement is nearest to a wanted one [px]; see uavnav/tasks/sensed.py. */
function steer(world, [right, forward], tolerance) {
  const isAhead = forward >= Math.hypot(right, forward) * Math.cos(radians(tolerance));
  const scores = actionsOf(world).map(([degrees, pixels]) => {
    const reached = along({ right, forward }, degrees);
    return isAhead && degrees !== 0 ? -Infinity : pixels * (2 * reached - pixels) + 0.01 * reached;
  });
  return best(scores);
}

/** Artificial potential field: the target pulls, each body within reach pushes. */
function apf(world, observation, needs) {
  const { gain, reach, tolerance } = needs.classics.apf;
  let [right, forward, away] = wayOf(world, observation, needs.scale) ?? STRAIGHT_ON;
  for (const echo of bodiesIn(world, observation)) {
    const rho = Math.max(echo.distance - world.drone_radius, 1);
    const push = rho > reach ? 0 : (gain * (1 / rho - 1 / reach)) / rho ** 2;
    right -= push * echo.right;
    forward -= push * echo.forward;
  }
  const pace = Math.min(away, world.n_distances - 1) / Math.max(Math.hypot(right, forward), 1e-6);
  return steer(world, [pace * right, pace * forward], tolerance);
}

/** Vector field histogram, VFH+: towards the cheapest opening between sectors that bodies block. */
function vfh(world, observation, needs) {
  const { window, spare, wide, sectors, aside } = needs.classics.vfh;
  const [right, forward, away] = wayOf(world, observation, needs.scale) ?? STRAIGHT_ON;
  const reach = Math.min(away, window) + world.drone_radius;
  const near = bodiesIn(world, observation).filter((echo) => echo.distance < reach);
  const isBlocked = (sector) =>
    near.some((echo) => {
      const half = Math.asin(Math.min((world.drone_radius + spare) / echo.distance, 1));
      return Math.abs(radians(sector) - Math.atan2(echo.right, echo.forward)) <= half;
    });
  const blocked = sectors.map(isBlocked);
  const aim = Math.atan2(right, forward) / radians(1);
  const isOpen = (sector, at) => {
    const [before, after] = [blocked.lastIndexOf(true, at), blocked.indexOf(true, at)];
    const [left, open] = [before < 0 ? Infinity : at - before, after < 0 ? Infinity : after - at];
    return !blocked[at] && (Math.min(left, open) >= wide || Math.abs(left - open) <= 1);
  };
  const cost = (sector) => 5 * Math.abs(((sector - aim + 540) % 360) - 180) + 2 * Math.abs(sector);
  const wanted = cheapest(sectors.filter(isOpen), cost);
  const angle = clamp(-wanted, ...furthestTurns(world));
  const densities = near.map(
    (echo) => Math.max(along(echo, angle), 0) * (1 - (echo.distance - world.drone_radius) / window),
  );
  const pace = (1 - Math.max(0, ...densities)) * Math.max(0, 1 - Math.abs(wanted) / aside);
  return encode(world, [angle, Math.round((world.n_distances - 1) * pace)]);
}

/** What `reactive` does in each world: of its constants, an observation, and the `needs` of that world. */
const REACTIONS = { drone: reactive, slalom: reactive, moving: dodge, goal: towardsGoal };
const REACTIVE = "reactive";

/** Every scripted policy: of a world's name, its task, an observation and random numbers, an action. */
const SCRIPTED = {
  [REACTIVE]: (name, { world, needs }, observation) => REACTIONS[name](world, observation, needs),
  apf: (name, { world, needs }, observation) => apf(world, observation, needs),
  vfh: (name, { world, needs }, observation) => vfh(world, observation, needs),
  straight: (name, { world }) => encode(world, [0, world.n_distances - 1]),
  random: (name, { world }, observation, draw) => Math.floor(actionsOf(world).length * draw()),
};
