"use strict";
// Maps to point at: a pixel's posterior, its point-spread function, and what is left of the prior.
(function () {
  const page = JSON.parse(document.getElementById("explorer-data").textContent);

  function bytes(text) {
    return Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  }
  const layers = page.layers.map((layer) => ({
    ...layer,
    values: new Float32Array(bytes(layer.values).buffer),
  }));
  const kernels = new Int8Array(bytes(page.kernels).buffer);
  const peaks = new Float32Array(bytes(page.kernel_peaks).buffer);
  const regions = Object.fromEntries(
    Object.entries(page.regions).map(([name, text]) => [
      name, new Float32Array(bytes(text).buffer),
    ])
  );
  const tables = Object.fromEntries(
    Object.entries(page.colours).map(([name, text]) => [name, bytes(text)])
  );
  const layer = (key) => layers.find((one) => one.key === key);

  // HEALPix in RING order: the pixel of a direction (z = sin b, longitude in radians)
  function pixelOf(nside, z, longitude) {
    const turn = 2 * Math.PI;
    const tt = (((longitude % turn) + turn) % turn) / (Math.PI / 2);
    const height = Math.abs(z);
    if (height <= 2 / 3) {
      const up = nside * (0.5 + tt - 0.75 * z);
      const down = nside * (0.5 + tt + 0.75 * z);
      const jp = Math.floor(up);
      const jm = Math.floor(down);
      const ring = nside + 1 + jp - jm;
      const shift = 1 - (ring & 1);
      let place = Math.floor((jp + jm - nside + shift + 1) / 2) % (4 * nside);
      if (place < 0) place += 4 * nside;
      return 2 * nside * (nside - 1) + (ring - 1) * 4 * nside + place;
    }
    const part = tt - Math.floor(tt);
    const size = nside * Math.sqrt(3 * (1 - height));
    const jp = Math.min(Math.floor(part * size), nside - 1);
    const jm = Math.min(Math.floor((1 - part) * size), nside - 1);
    const ring = jp + jm + 1;
    const place = Math.floor(tt * ring) % (4 * ring);
    return z > 0
      ? 2 * ring * (ring - 1) + place
      : 12 * nside * nside - 2 * ring * (ring + 1) + place;
  }

  // Mollweide, centre l = 0, longitude growing to the left; null outside
  function direction(u, v) {
    const y = 1 - 2 * v;
    const x = 2 * u - 1;
    if (x * x + y * y >= 1) return null;
    const theta = Math.asin(y);
    const z = (2 * theta + Math.sin(2 * theta)) / Math.PI;
    return { z, longitude: (-Math.PI * x) / Math.cos(theta) };
  }
  function place(z, longitude) {
    const b = Math.asin(z);
    let theta = b;
    for (let k = 0; k < 60; k += 1) {
      const slope = 2 + 2 * Math.cos(2 * theta);
      if (slope < 1e-9) break;
      theta -= (2 * theta + Math.sin(2 * theta) - Math.PI * z) / slope;
    }
    let l = longitude % (2 * Math.PI);
    if (l > Math.PI) l -= 2 * Math.PI;
    if (l < -Math.PI) l += 2 * Math.PI;
    return { u: (1 - (l / Math.PI) * Math.cos(theta)) / 2, v: (1 - Math.sin(theta)) / 2 };
  }

  function indices(canvas, nside) {
    const { width, height } = canvas;
    const found = new Int32Array(width * height).fill(-1);
    for (let row = 0; row < height; row += 1) {
      for (let column = 0; column < width; column += 1) {
        const at = direction((column + 0.5) / width, (row + 0.5) / height);
        if (at) found[row * width + column] = pixelOf(nside, at.z, at.longitude);
      }
    }
    return found;
  }

  function colourAt(one, value) {
    let share = (value - one.low) / (one.high - one.low);
    if (one.log) share = Math.log(Math.max(value, one.low) / one.low) / Math.log(one.high / one.low);
    return 3 * Math.round(255 * Math.min(1, Math.max(0, share)));
  }

  function paint(canvas, found, one, values) {
    const context = canvas.getContext("2d");
    const image = context.createImageData(canvas.width, canvas.height);
    const table = tables[one.colours];
    for (let k = 0; k < found.length; k += 1) {
      if (found[k] < 0) continue;
      const colour = colourAt(one, values[found[k]]);
      image.data.set([table[colour], table[colour + 1], table[colour + 2], 255], 4 * k);
    }
    context.putImageData(image, 0, 0);
    return context;
  }

  const never = layer("highest_altitude").values;
  function rim(context, canvas, found) {
    // edge of the region that never rose
    context.fillStyle = "#ffffff";
    for (let row = 1; row < canvas.height; row += 1) {
      for (let column = 1; column < canvas.width; column += 1) {
        const k = row * canvas.width + column;
        if ((row + column) % 6 > 3) continue;
        for (const other of [k - 1, k - canvas.width]) {
          if (found[k] >= 0 && found[other] >= 0 && never[found[k]] < 0 !== never[found[other]] < 0) {
            context.fillRect(column - 1, row - 1, 2, 2);
          }
        }
      }
    }
  }

  function mark(context, canvas, z, longitude, colour) {
    const at = place(z, longitude);
    for (const [width, style] of [[4, "#ffffff"], [2, colour]]) {
      context.beginPath();
      context.arc(at.u * canvas.width, at.v * canvas.height, 7, 0, 2 * Math.PI);
      context.lineWidth = width;
      context.strokeStyle = style;
      context.stroke();
    }
  }

  const map = document.getElementById("explorer-map");
  const spread = document.getElementById("explorer-psf");
  const choice = document.getElementById("explorer-layer");
  const inputs = ["l", "b"].map((name) => document.getElementById(`explorer-${name}`));
  const mapIndices = indices(map, page.nside);
  const spreadIndices = indices(spread, page.kernel_nside);
  for (const one of layers) {
    if (one.key !== "highest_altitude") choice.add(new Option(one.title, one.key));
  }
  const state = { z: 0, longitude: 0 };

  function number(value, unit) {
    if (!Number.isFinite(value)) return "not known";
    const size = Math.abs(value);
    const digits = size >= 1000 ? 0 : size >= 1 ? 2 : 4;
    const shown = value.toLocaleString("en", {
      minimumFractionDigits: digits, maximumFractionDigits: digits,
    });
    return unit ? `${shown} ${unit}` : shown;
  }

  function describe(pixel, region) {
    const mean = layer("mean").values[pixel];
    const std = layer("std").values[pixel];
    const truth = layer("truth");
    const l = ((state.longitude * 180) / Math.PI + 360) % 360;
    const b = (Math.asin(state.z) * 180) / Math.PI;
    const rows = [
      ["Galactic longitude, latitude", `${l.toFixed(2)}°, ${b.toFixed(2)}°`],
      ["pixel (RING)", String(pixel)],
      ["posterior mean", number(mean, "K")],
      ["standard deviation", number(std, "K")],
    ];
    if (truth) {
      rows.push(["truth", number(truth.values[pixel], "K")]);
      rows.push(["mean - truth", `${number((mean - truth.values[pixel]) / std)} standard deviations`]);
    }
    rows.push(
      ["share from the prior (ell ≥ 1)", number(layer("prior_fraction").values[pixel])],
      ["ever above the horizon", never[pixel] >= 0 ? "yes" : "no"],
      [`region of ${page.region_size_deg.toFixed(1)}° around it: mean`,
        number(regions.mean[region], "K")],
      ["its standard deviation", number(regions.std[region], "K")],
      ["its share from the prior", number(regions.prior_fraction[region])],
      ["peak of the point-spread function", number(peaks[region], "per sr")]
    );
    const list = document.getElementById("explorer-values");
    list.replaceChildren();
    for (const [name, value] of rows) {
      const term = document.createElement("dt");
      const text = document.createElement("dd");
      term.textContent = name;
      text.textContent = value;
      list.append(term, text);
    }
  }

  function bar(one) {
    const canvas = document.getElementById("explorer-bar");
    const context = canvas.getContext("2d");
    const table = tables[one.colours];
    for (let k = 0; k < canvas.width; k += 1) {
      const c = 3 * Math.round((255 * k) / (canvas.width - 1));
      context.fillStyle = `rgb(${table[c]}, ${table[c + 1]}, ${table[c + 2]})`;
      context.fillRect(k, 0, 1, canvas.height);
    }
    document.getElementById("explorer-low").textContent = number(one.low, one.unit);
    document.getElementById("explorer-high").textContent = number(one.high, one.unit);
  }

  function draw() {
    const one = layer(choice.value);
    const context = paint(map, mapIndices, one, one.values);
    rim(context, map, mapIndices);
    mark(context, map, state.z, state.longitude, "#000000");
    bar(one);
    const pixel = pixelOf(page.nside, state.z, state.longitude);
    const region = pixelOf(page.region_nside, state.z, state.longitude);
    const n = 12 * page.kernel_nside * page.kernel_nside;
    const kernel = kernels.subarray(region * n, (region + 1) * n);
    const scale = { low: -127, high: 127, colours: "diverging" };
    const below = paint(spread, spreadIndices, scale, kernel);
    mark(below, spread, state.z, state.longitude, "#000000");
    describe(pixel, region);
    const l = (((state.longitude * 180) / Math.PI) % 360 + 360) % 360;
    inputs[0].value = l.toFixed(1);
    inputs[1].value = ((Math.asin(state.z) * 180) / Math.PI).toFixed(1);
    map.setAttribute("aria-label", `${one.title}; chosen: pixel ${pixel}`);
  }

  function choose(longitude, b) {
    state.longitude = longitude;
    state.z = Math.sin(Math.max(-Math.PI / 2, Math.min(Math.PI / 2, b)));
    draw();
  }
  map.addEventListener("click", (event) => {
    const box = map.getBoundingClientRect();
    const at = direction(
      (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height
    );
    if (at) choose(at.longitude, Math.asin(at.z));
  });
  map.addEventListener("keydown", (event) => {
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
      const [l, b] = inputs.map((one) => (Number(one.value) * Math.PI) / 180);
      if (Number.isFinite(l) && Number.isFinite(b)) choose(l, b);
    });
  }
  choice.addEventListener("change", draw);
  draw();
  // for checks of the page: what is shown of a direction, in degrees
  window.explorer = {
    choose: (l, b) => choose((l * Math.PI) / 180, (b * Math.PI) / 180),
    at: (l, b) => {
      const z = Math.sin((b * Math.PI) / 180);
      const pixel = pixelOf(page.nside, z, (l * Math.PI) / 180);
      return { pixel, mean: layer("mean").values[pixel], std: layer("std").values[pixel] };
    },
  };
})();
