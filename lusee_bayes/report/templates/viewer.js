"use strict";
// A map to point at: layers of one channel or many behind a slider, the posterior of a direction, and
// its spectrum and point-spread function where the page has them.
(function () {
  const { bytes, floats, degrees, radians, pixelOf, number } = skyView;
  const page = JSON.parse(document.getElementById("viewer-data").textContent);
  const element = (name) => document.getElementById(`viewer-${name}`);
  const n = 12 * page.nside ** 2;
  const frequencies = page.frequencies;
  const many = frequencies.length > 1;

  const part = (values, channel) => {
    const size = values.length / frequencies.length;
    return values.slice(channel * size, (channel + 1) * size);
  };
  const cached = (make) => {
    const made = [];
    return (channel) => (made[channel] = made[channel] || make(channel));
  };
  // by name: of(channel) is the map at NSIDE, at(channel, z, longitude) its value in any direction
  const maps = {};
  // of coefficients
  for (const [name, text] of Object.entries(page.skies)) {
    const modes = floats(text);
    const lmax = Math.round(Math.sqrt(modes.length / frequencies.length)) - 1;
    maps[name] = {
      of: cached((channel) => sphere.synthesis(part(modes, channel), page.nside)),
      at: (channel, z, longitude) => {
        const y = sphere.harmonics(lmax, z, longitude);
        return part(modes, channel).reduce((sum, mode, k) => sum + mode * y[k], 0);
      },
    };
  }
  // of coarser pixels
  for (const [name, { nside, low, step, levels }] of Object.entries(page.pixels)) {
    const steps = new Uint16Array(bytes(levels).buffer);
    const value = cached((channel) => {
      const coarse = Float64Array.from(part(steps, channel), (k) => low[channel] + step[channel] * k);
      return sphere.between(coarse, nside);
    });
    maps[name] = {
      of: cached((channel) => sphere.sampled(value(channel), page.nside)),
      at: (channel, z, longitude) => value(channel)(z, longitude),
    };
  }
  // of others: f(channel, values)
  const combine = (names, f) => ({
    of: cached((channel) => {
      const given = names.map((name) => maps[name].of(channel));
      return Float32Array.from({ length: n }, (_, k) => f(channel, given.map((map) => map[k])));
    }),
    at: (channel, ...place) => f(channel, names.map((name) => maps[name].at(channel, ...place))),
  });
  if (maps.truth) {
    const percent = (channel, [mean, truth]) => (100 * (mean - truth)) / page.mean_k[channel];
    maps.residual = combine(["mean", "truth"], percent);
    maps.pull = combine(["mean", "truth", "std"], (_, [mean, truth, std]) => (mean - truth) / std);
  }
  const tables = Object.fromEntries(
    Object.entries(page.colours).map(([name, text]) => [name, bytes(text)])
  );
  const heights = floats(page.highest_altitude);
  const altitude = sphere.between(heights, Math.round(Math.sqrt(heights.length / 12)));
  const highest = sphere.sampled(altitude, page.nside);
  const regions = page.regions && Object.fromEntries(
    ["mean", "std", "prior_fraction"].map((name) => [name, floats(page.regions[name])])
  );
  const spread = cached((channel) => pointSpread(page.resolutions[channel]));

  const layers = [
    { key: "mean", title: "posterior mean", unit: "K", scale: "temperature" },
    { key: "std", title: "standard deviation", unit: "K", scale: "std" },
  ];
  if (maps.truth) {
    layers.push(
      { key: "truth", title: "truth", unit: "K", scale: "temperature" },
      {
        key: "residual", title: "mean - truth", unit: "% of the mean sky", scale: "residual",
        colours: "diverging",
      },
      {
        key: "pull", title: "pull, (mean - truth) / standard deviation", unit: "sigma",
        bounds: { low: -4, high: 4, log: false }, colours: "diverging",
      }
    );
  }
  if (maps.prior_fraction) {
    layers.push({
      key: "prior_fraction", title: "share from the prior", unit: "", scale: "prior_fraction",
    });
  }
  for (let k = 1; maps[`draw${k}`]; k += 1) {
    layers.push({
      key: `draw${k}`, title: `posterior draw ${k}`, unit: "K", scale: "temperature",
    });
  }

  const map = new skyView.View(element("map"), page.rotation, page.sources);
  const below = page.resolutions.length && new skyView.View(element("psf"), page.rotation, []);
  const choice = element("layer");
  for (const one of layers) choice.add(new Option(one.title, one.key));
  const slider = many && element("channel");
  const inputs = ["l", "b"].map(element);
  // the direction, the channel, and the values of the layer in it
  const state = { z: 0, longitude: 0, channel: 0, values: null, peak: 0 };
  const chosen = () => layers.find((one) => one.key === choice.value);

  const coordinates = (direction) => {
    const l = (degrees(direction.longitude) + 360) % 360;
    const icrs = skyView.equatorial(page.rotation, direction.z, direction.longitude);
    return {
      galactic: `${l.toFixed(2)}°, ${degrees(Math.asin(direction.z)).toFixed(2)}°`,
      equatorial: `${icrs.ra.toFixed(2)}°, ${icrs.dec.toFixed(2)}°`,
    };
  };

  function draw() {
    const one = chosen();
    const scale = one.bounds || page.scales[one.scale][state.channel];
    const table = tables[one.colours || "sequential"];
    const hatched = one.key === "std" && ((pixel) => highest[pixel] < 0);
    map.paint(page.nside, state.values, scale, table, hatched);
    map.rim(page.rim, one.colours === "diverging" ? "#1b1b1b" : "#ffffff");
    map.graticule();
    map.marks();
    map.ring(state.z, state.longitude, 8, "#4fc3f7");
    skyView.bar(element("bar"), scale, table);
    element("unit").textContent = one.unit;
  }
  // anew for another layer or channel
  function select() {
    const one = chosen();
    state.values = maps[one.key].of(state.channel);
    if (many) {
      const text = `${frequencies[state.channel]} MHz`;
      element("frequency").textContent = text;
      slider.setAttribute("aria-valuetext", text);
      // the parts of the page that belong to one channel
      for (const part of document.querySelectorAll("[data-channel]")) {
        part.hidden = Number(part.dataset.channel) !== state.channel;
      }
    }
    draw();
  }
  function drawSpread() {
    const kernel = spread(state.channel).kernel(state.z, state.longitude);
    state.peak = kernel.reduce((most, x) => Math.max(most, Math.abs(x)), 0);
    const most = state.peak || 1;
    const nside = page.resolutions[state.channel].nside;
    below.paint(nside, kernel, { low: -most, high: most }, tables.diverging);
    below.ring(state.z, state.longitude, 6, "#4fc3f7");
  }
  const probe = (name, channel) => maps[name].at(channel, state.z, state.longitude);
  function drawSpectrum() {
    const canvas = element("spectrum");
    const context = canvas.getContext("2d");
    const points = frequencies.map((f, k) => ({
      f, mean: probe("mean", k), std: probe("std", k), truth: maps.truth ? probe("truth", k) : NaN,
    }));
    const levels = points.flatMap((p) => [p.mean - p.std, p.mean, p.mean + p.std, p.truth]);
    const positive = levels.filter((x) => x > 0);
    const [low, high] = [0.8 * Math.min(...positive), 1.25 * Math.max(...positive)];
    const [first, last] = [0.95 * frequencies[0], 1.05 * frequencies[frequencies.length - 1]];
    context.font = "15px system-ui, sans-serif";
    const marks = skyView.ticks(low, high, true).map((y) => [y, `${y.toLocaleString("en")} K`]);
    const widest = Math.max(0, ...marks.map(([, text]) => context.measureText(text).width));
    const [left, top, right, bottom] = [widest + 14, 12, canvas.width - 14, canvas.height - 44];
    const share = (x, a, b) => Math.log(Math.max(x, a) / a) / Math.log(b / a);
    const xOf = (x) => left + share(x, first, last) * (right - left);
    const yOf = (y) => bottom - share(y, low, high) * (bottom - top);
    context.clearRect(0, 0, canvas.width, canvas.height);
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
    for (const [tick, text] of marks) {
      context.fillRect(left - 5, yOf(tick), 5, 1);
      context.fillText(text, left - 8, yOf(tick) + 5);
    }
    context.strokeStyle = "#d55e00";
    context.lineWidth = 2;
    context.setLineDash([6, 4]);
    context.beginPath();
    points.forEach((p, k) => {
      if (Number.isFinite(p.truth)) context[k ? "lineTo" : "moveTo"](xOf(p.f), yOf(p.truth));
    });
    context.stroke();
    context.setLineDash([]);
    context.fillStyle = context.strokeStyle = "#0072b2";
    points.forEach((p, k) => {
      const [up, down] = [yOf(p.mean + p.std), yOf(p.mean - p.std)];
      context.fillRect(xOf(p.f) - 1, up, 2, down - up);
      context.beginPath();
      context.arc(xOf(p.f), yOf(p.mean), k === state.channel ? 6 : 3.5, 0, 2 * Math.PI);
      context.fill();
    });
  }

  function rows() {
    const place = coordinates(state);
    const of = (name) => probe(name, state.channel);
    const observed = altitude(state.z, state.longitude) >= 0;
    const entries = [
      ["Galactic longitude, latitude", place.galactic],
      ["right ascension, declination (ICRS)", place.equatorial],
    ];
    if (many) entries.push(["frequency", `${frequencies[state.channel]} MHz`]);
    entries.push(["posterior mean", number(of("mean"), "K")]);
    entries.push(["standard deviation", number(of("std"), "K")]);
    if (maps.truth) {
      entries.push(["truth", number(of("truth"), "K")]);
      entries.push(["mean - truth", `${number(of("pull"))} standard deviations`]);
    }
    if (maps.prior_fraction) {
      const share = observed ? number(of("prior_fraction")) : "not observed";
      entries.push(["share from the prior (ℓ ≥ 1)", share]);
    }
    entries.push(["ever above the horizon", observed ? "yes" : "no"]);
    if (regions) {
      const { nside } = page.regions;
      const region = 12 * nside ** 2 * state.channel + pixelOf(nside, state.z, state.longitude);
      entries.push(
        [`region of ${page.regions.size_deg.toFixed(1)}° around it: mean`,
          number(regions.mean[region], "K")],
        ["its standard deviation", number(regions.std[region], "K")],
        ["its share from the prior",
          observed ? number(regions.prior_fraction[region]) : "not observed"]
      );
    }
    if (below) entries.push(["peak of the point-spread function", number(state.peak, "per sr")]);
    return entries;
  }
  function describe() {
    if (below) drawSpread();
    if (many) drawSpectrum();
    const list = element("values");
    list.replaceChildren();
    for (const [name, value] of rows()) {
      const [term, text] = ["dt", "dd"].map((tag) => document.createElement(tag));
      term.textContent = name;
      text.textContent = value;
      list.append(term, text);
    }
    const galactic = coordinates(state).galactic;
    map.canvas.setAttribute("aria-label", `${chosen().title}; chosen: l, b ${galactic}`);
  }
  function choose(longitude, b) {
    state.longitude = longitude;
    state.z = Math.sin(Math.max(-Math.PI / 2, Math.min(Math.PI / 2, b)));
    draw();
    describe();
    inputs[0].value = ((degrees(longitude) % 360 + 360) % 360).toFixed(1);
    inputs[1].value = degrees(Math.asin(state.z)).toFixed(1);
  }
  function hover(hit) {
    if (!hit) {
      element("hover").textContent = "\u00a0";
      return;
    }
    const one = chosen();
    const place = coordinates(hit);
    const value = number(maps[one.key].at(state.channel, hit.z, hit.longitude), one.unit);
    element("hover").textContent =
      `${one.title}: ${value} at l, b ${place.galactic}; RA, Dec ${place.equatorial}`;
  }

  map.listen({ hover, draw, choose: (hit) => choose(hit.longitude, Math.asin(hit.z)) });
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
    select();
    describe();
  });
  if (many) {
    const selectors = Array.from(document.querySelectorAll("select.channel"));
    for (const one of [slider, ...selectors]) {
      one.addEventListener("input", () => {
        state.channel = Number(one.value);
        for (const other of [slider, ...selectors]) other.value = one.value;
        select();
        describe();
      });
    }
  }
  skyView.controls(map, element, () => skyView.place(state.z, state.longitude), draw);
  const file = (kind) =>
    `${page.name}_${frequencies[state.channel]}MHz_${chosen().key}.${kind}`.replace(/\s/g, "_");
  const header = () => {
    const { title, unit } = chosen();
    return `${page.name}: ${title} at ${frequencies[state.channel]} MHz${unit && ` [${unit}]`}`;
  };
  const fits = () => downloads.fits(state.values, page.nside, chosen().title, chosen().unit);
  element("png").addEventListener("click", () => {
    downloads.picture(map.canvas, element("bar"), header(), file("png"));
  });
  element("fits").addEventListener("click", () => {
    downloads.save(new Blob(fits(), { type: "application/fits" }), file("fits"));
  });
  select();
  choose(0, 0);
  // for checks of the page: the values shown in a direction, in degrees
  window.viewer = {
    choose: (l, b) => choose(radians(l), radians(b)),
    at: (l, b, channel = 0) => {
      const place = [Math.sin(radians(b)), radians(l)];
      const available = ["mean", "std", "truth", "prior_fraction"].filter((name) => maps[name]);
      const values = available.map((name) => [name, maps[name].at(channel, ...place)]);
      return { ...skyView.equatorial(page.rotation, ...place), ...Object.fromEntries(values) };
    },
    map: (name, channel = 0) => Array.from(maps[name].of(channel)),
    pixel: (l, b) => pixelOf(page.nside, Math.sin(radians(b)), radians(l)),
    kernel: (l, b, channel = 0) =>
      Array.from(spread(channel).kernel(Math.sin(radians(b)), radians(l))),
    ticks: skyView.ticks,
    fits,
  };
})();
