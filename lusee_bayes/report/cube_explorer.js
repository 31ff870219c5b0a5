"use strict";
// Maps of every channel behind a slider; the spectrum of a direction.
(function () {
  const { bytes, degrees, radians, pixelOf, number } = skyView;
  const page = JSON.parse(document.getElementById("explorer-data").textContent);
  const element = (name) => document.getElementById(`explorer-${name}`);
  const n = 12 * page.nside * page.nside;
  const tables = Object.fromEntries(
    Object.entries(page.colours).map(([name, text]) => [name, bytes(text)])
  );
  const cubes = Object.fromEntries(
    Object.entries(page.cubes).map(([name, cube]) => [
      name, { ...cube, levels: new Uint16Array(bytes(cube.levels).buffer) },
    ])
  );
  const value = (name, channel, pixel) => {
    const cube = cubes[name];
    return cube.low[channel] + cube.step[channel] * cube.levels[channel * n + pixel];
  };
  const quantile = (values, share) => {
    const sorted = Float64Array.from(values).sort();
    return sorted[Math.min(sorted.length - 1, Math.max(0, Math.floor(share * sorted.length)))];
  };
  const plain = (name) => (channel) => {
    const found = new Float64Array(n);
    for (let p = 0; p < n; p += 1) found[p] = value(name, channel, p);
    return found;
  };
  const bright = (values, channel) => {
    const sky = (cubes.truth ? plain("truth")(channel) : values).filter((x) => x > 0);
    return { low: quantile(sky, 0.005), high: quantile(sky, 0.998), log: true };
  };
  const signed = (limit) => ({ low: -limit, high: limit, log: false });
  const layers = [
    { key: "mean", title: "posterior mean", unit: "K", of: plain("mean"), scale: bright },
    {
      key: "std", title: "standard deviation", unit: "K", of: plain("std"),
      scale: (v) => ({ low: quantile(v, 0.005), high: quantile(v, 0.9), log: true }),
    },
  ];
  if (cubes.truth) {
    const residual = (channel) => {
      const [mean, truth] = ["mean", "truth"].map((name) => plain(name)(channel));
      return mean.map((x, p) => x - truth[p]);
    };
    layers.push(
      { key: "truth", title: "truth", unit: "K", of: plain("truth"), scale: bright },
      {
        key: "residual", title: "mean - truth", unit: "K", of: residual, colours: "diverging",
        scale: (v) => signed(quantile(v.map(Math.abs), 0.99)),
      },
      {
        key: "pull", title: "pull, (mean - truth) / standard deviation", unit: "sigma",
        of: (channel) => residual(channel).map((x, p) => x / value("std", channel, p)),
        colours: "diverging", scale: () => signed(4),
      }
    );
  }
  const map = new skyView.View(element("map"), page.rotation, page.sources);
  const choice = element("layer");
  const slider = element("channel");
  for (const one of layers) choice.add(new Option(one.title, one.key));
  slider.max = page.frequencies.length - 1;
  const state = { z: 0, longitude: 0, values: null };
  if (page.nside < page.full_nside) {
    element("note").textContent =
      `Drawn with NSIDE ${page.nside}; the files have NSIDE ${page.full_nside}.`;
  }
  const chosen = () => layers.find((one) => one.key === choice.value);
  const channel = () => Number(slider.value);

  function draw() {
    const one = chosen();
    state.values = one.of(channel());
    const scale = one.scale(state.values, channel());
    const table = tables[one.colours || "sequential"];
    element("frequency").textContent = `${page.frequencies[channel()]} MHz`;
    map.paint(page.nside, state.values, scale, table, null);
    map.graticule();
    map.marks();
    map.ring(state.z, state.longitude, 8, "#4fc3f7");
    skyView.bar(element("bar"), scale, table);
    element("unit").textContent = one.unit;
  }
  function spectrum(pixel) {
    const canvas = element("spectrum");
    const context = canvas.getContext("2d");
    const [left, top, right, bottom] = [90, 12, canvas.width - 14, canvas.height - 44];
    const f = page.frequencies;
    const points = f.map((_, k) => ({
      mean: value("mean", k, pixel), std: value("std", k, pixel),
      truth: cubes.truth ? value("truth", k, pixel) : NaN,
    }));
    const known = points.flatMap((p) => [p.mean - p.std, p.mean, p.mean + p.std, p.truth]);
    const positive = known.filter((x) => x > 0);
    const [low, high] = [0.8 * Math.min(...positive), 1.25 * Math.max(...positive)];
    const share = (x, a, b) => Math.log(Math.max(x, a) / a) / Math.log(b / a);
    const [first, last] = [0.95 * f[0], 1.05 * f[f.length - 1]];
    const xOf = (x) => left + share(x, first, last) * (right - left);
    const yOf = (y) => bottom - share(y, low, high) * (bottom - top);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.font = "15px system-ui, sans-serif";
    context.fillStyle = context.strokeStyle = "#1b1b1b";
    context.lineWidth = 1;
    context.strokeRect(left, top, right - left, bottom - top);
    context.textAlign = "center";
    for (const tick of skyView.ticks(first, last, true)) {
      context.fillRect(xOf(tick), bottom, 1, 5);
      context.fillText(String(tick), xOf(tick), bottom + 20);
    }
    context.fillText("frequency [MHz]", (left + right) / 2, bottom + 39);
    context.textAlign = "right";
    for (const tick of skyView.ticks(low, high, true)) {
      context.fillRect(left - 5, yOf(tick), 5, 1);
      context.fillText(`${tick.toLocaleString("en")} K`, left - 8, yOf(tick) + 5);
    }
    context.strokeStyle = "#d55e00";
    context.lineWidth = 2;
    context.setLineDash([6, 4]);
    context.beginPath();
    points.forEach((p, k) => {
      if (Number.isFinite(p.truth)) context[k ? "lineTo" : "moveTo"](xOf(f[k]), yOf(p.truth));
    });
    context.stroke();
    context.setLineDash([]);
    context.fillStyle = context.strokeStyle = "#0072b2";
    points.forEach((p, k) => {
      const [up, down] = [yOf(p.mean + p.std), yOf(p.mean - p.std)];
      context.fillRect(xOf(f[k]) - 1, up, 2, down - up);
      context.beginPath();
      context.arc(xOf(f[k]), yOf(p.mean), k === channel() ? 6 : 3.5, 0, 2 * Math.PI);
      context.fill();
    });
  }
  function coordinates(at) {
    const l = (degrees(at.longitude) + 360) % 360;
    const there = skyView.equatorial(page.rotation, at.z, at.longitude);
    return [
      `${l.toFixed(2)}°, ${degrees(Math.asin(at.z)).toFixed(2)}°`,
      `${there.ra.toFixed(2)}°, ${there.dec.toFixed(2)}°`,
    ];
  }
  function describe() {
    const pixel = pixelOf(page.nside, state.z, state.longitude);
    const [galactic, equatorial] = coordinates(state);
    const at = (name) => value(name, channel(), pixel);
    const rows = [
      ["Galactic longitude, latitude", galactic],
      ["right ascension, declination (ICRS)", equatorial],
      ["frequency", `${page.frequencies[channel()]} MHz`],
      ["posterior mean", number(at("mean"), "K")],
      ["standard deviation", number(at("std"), "K")],
    ];
    if (cubes.truth) {
      rows.push(["truth", number(at("truth"), "K")]);
      const pull = (at("mean") - at("truth")) / at("std");
      rows.push(["mean - truth", `${number(pull)} standard deviations`]);
    }
    element("values").replaceChildren();
    for (const [name, text] of rows) {
      const [term, definition] = ["dt", "dd"].map((tag) => document.createElement(tag));
      term.textContent = name;
      definition.textContent = text;
      element("values").append(term, definition);
    }
    spectrum(pixel);
  }
  function all() {
    draw();
    describe();
  }
  function choose(at) {
    Object.assign(state, { z: at.z, longitude: at.longitude });
    all();
  }
  function tell(at) {
    if (!at) {
      element("hover").textContent = "\u00a0";
      return;
    }
    const [galactic, equatorial] = coordinates(at);
    const there = number(state.values[pixelOf(page.nside, at.z, at.longitude)], chosen().unit);
    element("hover").textContent =
      `${chosen().title}: ${there} at l, b ${galactic}; RA, Dec ${equatorial}`;
  }
  map.listen({ tell, draw, choose });
  skyView.controls(map, element, () => skyView.place(state.z, state.longitude), draw);
  choice.addEventListener("change", draw);
  slider.addEventListener("input", all);
  all();
  // for checks of the page, in degrees
  window.explorer = {
    at: (k, l, b) => {
      const pixel = pixelOf(page.nside, Math.sin(radians(b)), radians(l));
      return Object.fromEntries(Object.keys(cubes).map((name) => [name, value(name, k, pixel)]));
    },
  };
})();
