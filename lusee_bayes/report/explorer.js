"use strict";
// A map to point at: a pixel's posterior, its point-spread function, and what is left of the prior.
(function () {
  const { bytes, floats, degrees, radians, pixelOf, number } = skyView;
  const page = JSON.parse(document.getElementById("explorer-data").textContent);
  const element = (name) => document.getElementById(`explorer-${name}`);
  const layers = page.layers.map((one) => ({ ...one, values: one.values && floats(one.values) }));
  const layer = (key) => layers.find((one) => one.key === key);
  // what follows from other layers
  const derived = {
    residual: (p) => layer("mean").values[p] - layer("truth").values[p],
    pull: (p) => (layer("mean").values[p] - layer("truth").values[p]) / layer("std").values[p],
  };
  for (const one of layers) {
    if (!one.values) one.values = layer("mean").values.map((_, p) => derived[one.key](p));
  }
  const regions = Object.fromEntries(
    Object.entries(page.regions).map(([name, text]) => [name, floats(text)])
  );
  const tables = Object.fromEntries(
    Object.entries(page.colours).map(([name, text]) => [name, bytes(text)])
  );
  const spreads = pointSpread(page.point_spread);
  const never = layer("highest_altitude").values;
  const map = new skyView.View(element("map"), page.rotation, page.sources);
  const below = new skyView.View(element("psf"), page.rotation, []);
  const choice = element("layer");
  const inputs = ["l", "b"].map(element);
  for (const one of layers) {
    if (one.key !== "highest_altitude") choice.add(new Option(one.title, one.key));
  }
  const state = { z: 0, longitude: 0, kernel: null };

  const coordinates = (at) => {
    const l = (degrees(at.longitude) + 360) % 360;
    const there = skyView.equatorial(page.rotation, at.z, at.longitude);
    return {
      galactic: `${l.toFixed(2)}°, ${degrees(Math.asin(at.z)).toFixed(2)}°`,
      equatorial: `${there.ra.toFixed(2)}°, ${there.dec.toFixed(2)}°`,
    };
  };

  function describe() {
    const pixel = pixelOf(page.nside, state.z, state.longitude);
    const region = pixelOf(page.region_nside, state.z, state.longitude);
    const mean = layer("mean").values[pixel];
    const std = layer("std").values[pixel];
    const truth = layer("truth");
    const at = coordinates(state);
    const rows = [
      ["Galactic longitude, latitude", at.galactic],
      ["right ascension, declination (ICRS)", at.equatorial],
      ["pixel (RING)", String(pixel)],
      ["posterior mean", number(mean, "K")],
      ["standard deviation", number(std, "K")],
    ];
    if (truth) {
      rows.push(["truth", number(truth.values[pixel], "K")]);
      const pull = number((mean - truth.values[pixel]) / std);
      rows.push(["mean - truth", `${pull} standard deviations`]);
    }
    rows.push(
      ["share from the prior (ell ≥ 1)", number(layer("prior_fraction").values[pixel])],
      ["ever above the horizon", never[pixel] >= 0 ? "yes" : "no"],
      [`region of ${page.region_size_deg.toFixed(1)}° around it: mean`,
        number(regions.mean[region], "K")],
      ["its standard deviation", number(regions.std[region], "K")],
      ["its share from the prior", number(regions.prior_fraction[region])],
      ["peak of the point-spread function", number(state.peak, "per sr")]
    );
    const list = element("values");
    list.replaceChildren();
    for (const [name, value] of rows) {
      const term = document.createElement("dt");
      const text = document.createElement("dd");
      term.textContent = name;
      text.textContent = value;
      list.append(term, text);
    }
    map.canvas.setAttribute("aria-label", `${layer(choice.value).title}; chosen: pixel ${pixel}`);
  }

  function draw() {
    const one = layer(choice.value);
    const hidden = (p) => never[p] < 0;
    map.paint(page.nside, one.values, one, tables[one.colours], one.key === "std" ? hidden : null);
    map.rim(page.nside, hidden);
    map.graticule();
    map.marks();
    map.ring(state.z, state.longitude, 8, "#4fc3f7");
    skyView.bar(element("bar"), one, tables[one.colours]);
    element("unit").textContent = one.unit;
  }
  function drawSpread() {
    state.kernel = spreads.kernel(state.z, state.longitude);
    state.peak = state.kernel.reduce((most, x) => Math.max(most, Math.abs(x)), 0);
    const most = state.peak || 1;
    const scale = { low: -most, high: most };
    below.paint(page.point_spread.nside, state.kernel, scale, tables.diverging);
    below.ring(state.z, state.longitude, 6, "#4fc3f7");
  }
  function choose(longitude, b) {
    state.longitude = longitude;
    state.z = Math.sin(Math.max(-Math.PI / 2, Math.min(Math.PI / 2, b)));
    draw();
    drawSpread();
    describe();
    inputs[0].value = ((degrees(longitude) % 360 + 360) % 360).toFixed(1);
    inputs[1].value = degrees(Math.asin(state.z)).toFixed(1);
  }
  function tell(at) {
    if (!at) {
      element("hover").textContent = "\u00a0";
      return;
    }
    const one = layer(choice.value);
    const there = coordinates(at);
    const value = number(one.values[pixelOf(page.nside, at.z, at.longitude)], one.unit);
    element("hover").textContent =
      `${one.title}: ${value} at l, b ${there.galactic}; RA, Dec ${there.equatorial}`;
  }
  map.listen({ tell, draw, choose: (at) => choose(at.longitude, Math.asin(at.z)) });
  map.canvas.addEventListener("keydown", (event) => {
    const step = Math.PI / 90;
    const moves = {
      ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step],
    };
    const move = moves[event.key];
    if (!move) return;
    event.preventDefault();
    choose(state.longitude + move[0], Math.asin(state.z) + move[1]);
  });
  for (const input of inputs) {
    input.addEventListener("change", () => {
      const [l, b] = inputs.map((one) => radians(Number(one.value)));
      if (Number.isFinite(l) && Number.isFinite(b)) choose(l, b);
    });
  }
  choice.addEventListener("change", () => {
    draw();
    describe();
  });
  skyView.controls(map, element, () => skyView.place(state.z, state.longitude), draw);
  choose(0, 0);
  // for checks of the page: what is shown of a direction, in degrees
  window.explorer = {
    choose: (l, b) => choose(radians(l), radians(b)),
    at: (l, b) => {
      const z = Math.sin(radians(b));
      const pixel = pixelOf(page.nside, z, radians(l));
      const { ra, dec } = skyView.equatorial(page.rotation, z, radians(l));
      return { pixel, ra, dec, mean: layer("mean").values[pixel], std: layer("std").values[pixel] };
    },
    kernel: (l, b) => Array.from(spreads.kernel(Math.sin(radians(b)), radians(l))),
    ticks: skyView.ticks,
  };
})();
