
/* A page of runs that train: it loads itself again every few seconds, where the reader left it. */

const KEPT = "uavnav report";
const left = JSON.parse(sessionStorage.getItem(KEPT) ?? "null");
if (left) {
  document.querySelectorAll("details").forEach((one, place) => { one.open = left.open.includes(place); });
  scrollTo(0, left.y);
}
setInterval(() => {
  if (document.querySelector(".replay [aria-label=pause]")) return; // who watches an episode sees its end
  const open = [...document.querySelectorAll("details")].flatMap((one, place) => (one.open ? [place] : []));
  sessionStorage.setItem(KEPT, JSON.stringify({ open, y: scrollY }));
  location.reload();
}, 5000);
