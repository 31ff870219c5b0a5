// What tests of the viewer do on the page, by the names of their parts.
// === channels
told.at = [0, 1, 2].map((k) => points.map((p) => viewer.at(...p, k)));
told.texts = [0, 2].map((k) => {
  elements["viewer-channel"].value = k;
  elements["viewer-channel"].listeners.input();
  return elements["viewer-frequency"].textContent;
});
told.options = elements["viewer-layer"].options.map((one) => one.value);
told.rows = elements["viewer-values"].rows.map((one) => one.textContent);
told.hidden = parts.map((one) => one.hidden);
elements["second"].value = 1;
elements["second"].listeners.input();
told.chosen = ["viewer-channel", "first"].map((id) => elements[id].value);
told.shown = parts.map((one) => !one.hidden);
// === pointer
viewer.choose(280, -30);
told.rows = elements["viewer-values"].rows.map((one) => one.textContent);
elements["viewer-map"].listeners.pointermove({ clientX: 200, clientY: 100, buttons: 0 });
told.hover = elements["viewer-hover"].textContent;
told.texts = elements["viewer-map"].texts;
told.options = elements["viewer-layer"].options.map((one) => one.value);
told.ticks = [viewer.ticks(1, 1000, true), viewer.ticks(-4, 4, false),
  viewer.ticks(3700, 6300, true)];
const seen = (id) => elements[id].image.data.filter((x, k) => k % 4 === 3 && x).length;
told.seen = [seen("viewer-map"), seen("viewer-psf")];
elements["viewer-in"].listeners.click();
told.zoomed = seen("viewer-map");
// === keys
const place = () => ["l", "b"].map((name) => Number(elements[`viewer-${name}`].value));
const press = (key) => {
  elements["viewer-map"].listeners.keydown({ key, preventDefault() {} });
  return place();
};
told.places = [place(), ...["ArrowLeft", "ArrowUp", "ArrowRight", "ArrowDown"].map(press)];
elements["viewer-l"].value = "30"; elements["viewer-b"].value = "-45";
elements["viewer-l"].listeners.change();
told.rows = elements["viewer-values"].rows.map((one) => one.textContent);
