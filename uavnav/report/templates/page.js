"use strict";

/* Sections are folded: a link to one opens it, and print shows all of them. */

function unfold() {
  const target = location.hash && document.getElementById(location.hash.slice(1));
  const folded = target && (target.closest("details") ?? target.querySelector(":scope > .fold"));
  if (!folded) return;
  folded.open = true;
  target.scrollIntoView();
}

const opened = []; // only for print
addEventListener("hashchange", unfold);
addEventListener("beforeprint", () => {
  opened.push(...document.querySelectorAll("details:not([open])"));
  for (const one of opened) one.open = true;
});
addEventListener("afterprint", () => {
  for (const one of opened.splice(0)) one.open = false;
});
for (const link of document.querySelectorAll("nav a")) link.addEventListener("click", () => setTimeout(unfold)); // again, too
unfold();
