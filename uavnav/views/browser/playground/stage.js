/*
 * The arena as one touches it: steering by pointer, and obstacles drawn, moved and sized by pointer.
 */

const EDGE = 14; // [px] from a circle's edge within which a drag changes its size
const ARRIVED = 15; // [px] from the pointer a drone stops
const SLOW_DOWN = 45; // [degrees] from the way to the pointer above which a drone turns before it flies

/** The turn [degrees] and distance [px] of the action that brings a drone nearer to a point. */
function towards(world, { x, y, heading }, [toX, toY]) {
  const [dx, dy] = [toX - x, toY - y];
  const away = Math.hypot(dx, dy);
  const wanted = Math.round(Math.atan2(dy, dx) / radians(1));
  const turn = ((wanted - heading + 900) % 360) - 180;
  if (away < ARRIVED) return [0, 0];
  const pixels = Math.abs(turn) > SLOW_DOWN ? 1 : clamp(Math.floor(away / 8), 1, world.n_distances - 1);
  return [clamp(turn, ...furthestTurns(world)), pixels];
}

/** A circle of the world's sizes, within it; undefined where it covers a place [x, y, room] in `free`. */
function allowed(world, [x, y, radius], free) {
  const size = clamp(radius, world.obstacle_radius_min, world.obstacle_radius_max);
  const inside = [clamp(x, 0, world.width), clamp(y, 0, world.height), size];
  const circle = inside.map((number) => f32(Math.round(10 * number) / 10));
  return free.every((place) => toEdge(place, circle) >= place[2]) ? circle : undefined;
}

class Stage {
  /** app: the page; element: with the canvas inside. */
  constructor(app, element) {
    Object.assign(this, { app, element, canvas: element.querySelector("canvas") });
    this.drawing = false; // whether the pointer draws obstacles
    this.selected = -1; // the circle that keys and buttons change
    this.target = null; // [x, y] px where a held pointer is
    this.held = null; // what a drag of the selected circle does
    this.touched = false; // by a finger or a pen, whose long press asks for a menu
    const listen = (name, act) => {
      this.canvas.addEventListener(name, (event) => act.call(this, event, this.at(event)));
    };
    const point = (name, act) => listen(name, (event, at) => event.isPrimary && act.call(this, event, at));
    point("pointerdown", this.press);
    point("pointermove", this.drag);
    for (const name of ["pointerup", "pointercancel"]) point(name, this.release);
    listen("contextmenu", this.erase);
  }

  /** Where a pointer is in the world [px]. */
  at({ offsetX, offsetY }) {
    const { canvas: { clientWidth, clientHeight }, app: { world } } = this;
    return [(offsetX / clientWidth) * world.width, (1 - offsetY / clientHeight) * world.height];
  }

  press(event, point) {
    this.touched = event.pointerType !== "mouse" && event.button === 0;
    if (event.button !== 0) return;
    this.element.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    if (this.drawing) this.grasp(point);
    else {
      const isNear = ({ state: { x, y } }) => Math.hypot(x - point[0], y - point[1]) < 30;
      const near = this.app.race.piloted.find(isNear);
      if (near) this.app.focusOn(near.place + 1);
      if (near && near.pilot !== YOU) return;
      this.target = point;
      this.app.begin();
    }
  }

  drag(event, point) {
    if (this.target) this.target = point;
    if (this.held) this.held(point);
  }

  release() {
    if (this.target) this.app.race.hand = [0, 0];
    this.target = this.held = null;
  }

  /** Take hold of a circle by its inside or its edge, or begin a new one. */
  grasp([x, y]) {
    const { circles } = this.app.race;
    this.selected = circles.findLastIndex((circle) => toEdge([x, y], circle) < EDGE / 2);
    const isSized = this.selected < 0 || toEdge([x, y], circles[this.selected]) > -EDGE;
    if (this.selected < 0 && !this.app.add([x, y, 0])) return;
    const [cx, cy, radius] = this.app.race.circles[this.selected];
    this.held = ([toX, toY]) => {
      if (isSized) this.change([cx, cy, Math.hypot(toX - cx, toY - cy)]);
      else this.change([cx + toX - x, cy + toY - y, radius]);
    };
  }

  /** Another circle or none is selected; whichever was held is so no more. */
  select(place) {
    this.selected = place;
    this.held = null;
  }

  change(circle) {
    const there = allowed(this.app.world, circle, this.app.race.free);
    if (there) this.app.edit(this.app.race.circles.with(this.selected, there), this.selected);
  }

  erase(event, point) {
    if (this.drawing || this.touched) event.preventDefault();
    if (!this.drawing || this.touched) return;
    this.selected = this.app.race.circles.findLastIndex((circle) => toEdge(point, circle) < 0);
    this.app.remove();
  }

  /** Draw the moment so much of the way [0 to 1] from the last poses to these. focus: place of a drone. */
  draw(share, focus) {
    const { race, world, pilots } = this.app;
    const inFocus = ({ place }) => place === focus;
    const shown = race.piloted.sort((one, other) => inFocus(one) - inFocus(other)); // that one above all
    const drones = shown.map((drone) => {
      const { place, state: { x, y, heading } } = drone;
      const pose = race.poseAt(drone, drone.ended ? 1 : share);
      const seen = !drone.ended && (place === focus || (drone.pilot === YOU && race.begun));
      const slots = seen ? slotsOf(world, drone.observation) : [];
      return {
        pose,
        trail: [...drone.trail, [pose.x, pose.y]],
        sensed: sensedPoints(world, [x, y], planeAxes(radians(heading)), slots),
        crashed: drone.ended === "collision",
        sign: String(place + 1),
        accent: pilots[place],
        ink: inkOn(pilots[place]),
        faint: !seen,
      };
    });
    const there = { circles: race.obstaclesAt(share), goal: race.layout.goal };
    const { context, thick, colours } = drawArena(this.canvas, { world, ...there, drones });
    if (this.drawing) this.drawHelp(context, thick, colours);
  }

  /** While one draws: what must stay free, and the selected circle. */
  drawHelp(context, thick, colours) {
    const { race } = this.app;
    context.setLineDash([6 * thick, 6 * thick]);
    for (const place of race.free) ring(context, ...place, 2 * thick, colours.muted);
    context.setLineDash([]);
    if (race.circles[this.selected]) ring(context, ...race.circles[this.selected], 4 * thick, colours.accent);
  }
}
