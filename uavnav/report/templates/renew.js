
/* A page of runs that train: it loads itself again every few seconds, where the reader left it. */

const KEPT = "uavnav report";
const AGAIN = 5000; // [ms]
const player = document.getElementById("replay-player")?.player;
const parts = [...document.querySelectorAll(".replay, .replay [data-part]")];
const left = JSON.parse(sessionStorage.getItem(KEPT) ?? "null");
let used = -Infinity; // when the reader pressed or changed something [ms]
if (left) {
  document.querySelectorAll("details").forEach((one, place) => { one.open = left.open.includes(place); });
  if (left.bookmark) player?.open(left.bookmark);
  parts[left.focus]?.focus({ preventScroll: true });
  scrollTo(0, left.y);
}
const use = () => { used = performance.now(); };
for (const name of ["pointerdown", "keydown", "input"]) addEventListener(name, use);
setInterval(() => {
  if (player?.playing || performance.now() - used < AGAIN) return; // who watches an episode sees its end
  const open = [...document.querySelectorAll("details")].flatMap((one, place) => (one.open ? [place] : []));
  const focus = parts.indexOf(document.activeElement);
  const where = { open, y: scrollY, bookmark: player?.bookmark, focus };
  sessionStorage.setItem(KEPT, JSON.stringify(where));
  location.reload();
}, AGAIN);
