// What a page says of itself; the first part runs before the page's own scripts.
window.problems = [];
addEventListener("error", (e) => problems.push(String(e.message)));
for (const kind of ["error", "warn"]) console[kind] = (...a) => problems.push(a.join(" "));
// ---
const beyond = (e) => e.getBoundingClientRect().right > innerWidth + 1;
const shown = [...document.querySelectorAll("img, canvas, dl, p, h1, h2")];
const found = {
  errors: window.problems, width: innerWidth, needed: document.documentElement.scrollWidth,
  cut: shown.filter((e) => beyond(e) && !e.closest(".scroll, figure")).length, pixels: []};
if (window.viewer) for (const [l, b] of POINTS) found.pixels.push(viewer.at(l, b));
if (window.viewer) { viewer.choose(POINTS[0][0], POINTS[0][1]);
  found.values = document.getElementById("viewer-values").textContent; }
const text = document.createElement("pre"); text.id = "found";
text.textContent = JSON.stringify(found); document.body.append(text);
