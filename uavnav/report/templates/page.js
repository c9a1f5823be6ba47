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
for (const link of document.querySelectorAll("nav a")) link.addEventListener("click", () => setTimeout(unfold)); // again, too
unfold();
