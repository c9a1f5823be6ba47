"use strict";

/* Sections are folded: a link to one opens it. */

function unfold() {
  const target = location.hash && document.getElementById(location.hash.slice(1));
  const folded = target && (target.closest("details") ?? target.querySelector(":scope > .fold"));
  if (!folded) return;
  folded.open = true;
  target.scrollIntoView();
}

addEventListener("hashchange", unfold);
const again = () => setTimeout(unfold); // a link to what the address names already
for (const link of document.querySelectorAll("nav a")) link.addEventListener("click", again);
unfold();
