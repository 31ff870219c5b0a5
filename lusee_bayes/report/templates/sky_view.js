"use strict";
// Galactic Mollweide views of HEALPix maps on a canvas: zoom, graticule, sources, colour bars.
const skyView = (function () {
  const TURN = 2 * Math.PI;
  const degrees = (x) => (x * 180) / Math.PI;
  const radians = (x) => (x * Math.PI) / 180;
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const floats = (text) => new Float32Array(bytes(text).buffer);

  // HEALPix in RING order: the pixel of a direction (z = sin b, longitude in radians)
  function pixelOf(nside, z, longitude) {
    const tt = (((longitude % TURN) + TURN) % TURN) / (Math.PI / 2);
    const height = Math.abs(z);
    if (height <= 2 / 3) {
      const jp = Math.floor(nside * (0.5 + tt - 0.75 * z));
      const jm = Math.floor(nside * (0.5 + tt + 0.75 * z));
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
    let theta = Math.asin(z);
    for (let k = 0; k < 60; k += 1) {
      const slope = 2 + 2 * Math.cos(2 * theta);
      if (slope < 1e-9) break;
      theta -= (2 * theta + Math.sin(2 * theta) - Math.PI * z) / slope;
    }
    let l = longitude % TURN;
    if (l > Math.PI) l -= TURN;
    if (l < -Math.PI) l += TURN;
    return { u: (1 - (l / Math.PI) * Math.cos(theta)) / 2, v: (1 - Math.sin(theta)) / 2 };
  }

  // rotation: rows of the matrix from Galactic to ICRS
  function turned(rotation, z, longitude, back) {
    const r = Math.sqrt(Math.max(0, 1 - z * z));
    const v = [r * Math.cos(longitude), r * Math.sin(longitude), z];
    const w = [0, 1, 2].map((i) =>
      [0, 1, 2].reduce((sum, j) => sum + rotation[back ? 3 * j + i : 3 * i + j] * v[j], 0)
    );
    return { z: Math.min(1, Math.max(-1, w[2])), longitude: Math.atan2(w[1], w[0]) };
  }
  function equatorial(rotation, z, longitude) {
    const icrs = turned(rotation, z, longitude, false);
    return { ra: (degrees(icrs.longitude) + 360) % 360, dec: degrees(Math.asin(icrs.z)) };
  }

  function number(value, unit) {
    if (!Number.isFinite(value)) return "not known";
    const size = Math.abs(value);
    const digits = size >= 1000 ? 0 : size >= 1 ? 2 : 4;
    const shown = value.toLocaleString("en", {
      minimumFractionDigits: digits, maximumFractionDigits: digits,
    });
    return unit ? `${shown} ${unit}` : shown;
  }

  // ticks of a scale: 1, 2, 5 times powers of ten, evenly spaced unless logarithmic
  function ticks(low, high, log) {
    const values = [];
    if (log) {
      for (let e = Math.floor(Math.log10(low)); e <= Math.ceil(Math.log10(high)); e += 1) {
        for (const m of [1, 2, 5]) values.push(m * 10 ** e);
      }
      const inside = values.filter((x) => x >= low && x <= high);
      if (inside.length < 3) return ticks(low, high, false).filter((x) => x >= low);
      return inside.length > 7 ? inside.filter((x) => /^1/.test(x.toExponential())) : inside;
    }
    const raw = (high - low) / 5;
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = power * [1, 2, 5, 10].find((m) => m * power >= raw);
    for (let x = Math.ceil(low / step) * step; x <= high + step * 1e-9; x += step) {
      values.push(Math.abs(x) < step * 1e-9 ? 0 : x);
    }
    return values;
  }
  function shareOf(scale, value) {
    if (!scale.log) return (value - scale.low) / (scale.high - scale.low);
    return Math.log(Math.max(value, scale.low) / scale.low) / Math.log(scale.high / scale.low);
  }
  function bar(canvas, scale, table) {
    const context = canvas.getContext("2d");
    const [edge, height] = [24, 18];
    const width = canvas.width - 2 * edge;
    context.clearRect(0, 0, canvas.width, canvas.height);
    for (let k = 0; k < width; k += 1) {
      const c = 3 * Math.round((255 * k) / (width - 1));
      context.fillStyle = `rgb(${table[c]}, ${table[c + 1]}, ${table[c + 2]})`;
      context.fillRect(edge + k, 0, 1, height);
    }
    context.fillStyle = context.strokeStyle = "#1b1b1b";
    context.font = "14px system-ui, sans-serif";
    context.textAlign = "center";
    let last = -Infinity;
    for (const tick of ticks(scale.low, scale.high, scale.log)) {
      const x = edge + shareOf(scale, tick) * width;
      context.fillRect(x - 0.5, height, 1, 5);
      const text = Number(tick.toPrecision(3)).toLocaleString("en", { maximumFractionDigits: 6 });
      const half = context.measureText(text).width / 2;
      if (x - half < last + 6) continue;
      context.fillText(text, x, height + 19);
      last = x + half;
    }
  }

  class View {
    constructor(canvas, rotation, sources) {
      Object.assign(this, { canvas, rotation, sources, zoom: 1, u: 0, v: 0, cache: new Map() });
      this.grid = "galactic";
      this.names = true;
    }
    // where a point of the canvas lies in the whole view, from 0 to 1
    whole(x, y) {
      return [this.u + x / this.zoom, this.v + y / this.zoom];
    }
    directionAt(x, y) {
      return direction(...this.whole(x, y));
    }
    point(z, longitude) {
      const position = place(z, longitude);
      return [
        (position.u - this.u) * this.zoom * this.canvas.width,
        (position.v - this.v) * this.zoom * this.canvas.height,
      ];
    }
    // zoom about a point of the canvas that stays where it is
    scale(factor, x, y) {
      const [u, v] = this.whole(x, y);
      this.zoom = Math.min(16, Math.max(1, this.zoom * factor));
      this.move(u - x / this.zoom, v - y / this.zoom);
    }
    move(u, v) {
      const most = 1 - 1 / this.zoom;
      this.u = Math.min(most, Math.max(0, u));
      this.v = Math.min(most, Math.max(0, v));
      this.cache.clear();
      if (this.canvas.style) this.canvas.style.touchAction = this.zoom > 1 ? "none" : "auto";
    }
    indices(nside) {
      if (this.cache.has(nside)) return this.cache.get(nside);
      const { width, height } = this.canvas;
      const pixels = new Int32Array(width * height).fill(-1);
      for (let row = 0; row < height; row += 1) {
        for (let column = 0; column < width; column += 1) {
          const hit = this.directionAt((column + 0.5) / width, (row + 0.5) / height);
          if (hit) pixels[row * width + column] = pixelOf(nside, hit.z, hit.longitude);
        }
      }
      this.cache.set(nside, pixels);
      return pixels;
    }
    // scale: low, high, log; hatched: pixel -> whether it is hatched
    paint(nside, values, scale, table, hatched) {
      const pixels = this.indices(nside);
      const { width, height } = this.canvas;
      const context = this.canvas.getContext("2d");
      const image = context.createImageData(width, height);
      for (let k = 0; k < pixels.length; k += 1) {
        if (pixels[k] < 0) continue;
        const share = shareOf(scale, values[pixels[k]]);
        const c = 3 * Math.round(255 * Math.min(1, Math.max(0, share)));
        const line = ((k % width) + Math.floor(k / width)) % 14 < 2;
        const lift = line && hatched && hatched(pixels[k]) ? 90 : 0;
        for (let i = 0; i < 3; i += 1) image.data[4 * k + i] = Math.abs(table[c + i] - lift);
        image.data[4 * k + 3] = 255;
      }
      context.putImageData(image, 0, 0);
      return context;
    }
    // a line through points (z, longitude), broken where it leaves the view at the other side
    curve(points) {
      const context = this.canvas.getContext("2d");
      let before = null;
      context.beginPath();
      for (const { z, longitude } of points) {
        const [x, y] = this.point(z, longitude);
        const far = before && Math.hypot(x - before[0], y - before[1]) > 0.2 * this.canvas.width;
        if (!before || far) context.moveTo(x, y);
        else context.lineTo(x, y);
        before = [x, y];
      }
      context.stroke();
    }
    // dashes along lines of l and b in degrees: light on a dark map, dark on a light one
    rim(lines, colour) {
      const context = this.canvas.getContext("2d");
      const growth = this.growth();
      context.strokeStyle = colour;
      context.lineWidth = 2 * growth;
      context.setLineDash([9 * growth, 6 * growth]);
      for (const line of lines) {
        this.curve(line.map(([l, b]) => ({ z: Math.sin(radians(b)), longitude: radians(l) })));
      }
      context.setLineDash([]);
    }
    graticule() {
      if (this.grid === "none") return;
      const galactic = this.grid === "galactic";
      const context = this.canvas.getContext("2d");
      const to = (lon, lat) => {
        const z = Math.sin(radians(lat));
        const node = { z, longitude: radians(lon) };
        return galactic ? node : turned(this.rotation, z, node.longitude, true);
      };
      const curve = (points) => this.curve(points.map((one) => to(...one)));
      context.strokeStyle = "rgb(200 200 200 / 45%)";
      context.lineWidth = 1;
      const steps = Array.from({ length: 91 }, (_, k) => k);
      for (let lon = -180; lon <= 180; lon += 30) curve(steps.map((k) => [lon, -90 + 2 * k]));
      for (let lat = -60; lat <= 60; lat += 30) curve(steps.map((k) => [-180 + 4 * k, lat]));
      const unit = (lon) => (galactic ? `${(lon + 360) % 360}°` : `${((lon + 360) % 360) / 15}h`);
      // half of them where they would touch
      const apart = this.growth() / this.zoom > 1.5 ? 60 : 30;
      for (let lon = apart - 180; lon < 180; lon += apart) this.label(unit(lon), to(lon, 0), 0, -6);
      for (let lat = -60; lat <= 60; lat += 30) {
        if (lat) this.label(`${lat}°`, to(galactic ? 90 : 0, lat), 0, -6);
      }
    }
    // names and marks grow where a narrow screen shrinks the canvas, up to twice
    growth() {
      const { width } = this.canvas.getBoundingClientRect();
      return Math.min(2, Math.max(1, this.canvas.width / (1.2 * width)));
    }
    label(text, anchor, dx, dy, size = 15) {
      const context = this.canvas.getContext("2d");
      const [x, y] = this.point(anchor.z, anchor.longitude);
      const growth = this.growth();
      [dx, dy, size] = [dx * growth, dy * growth, size * growth];
      context.font = `${size}px system-ui, sans-serif`;
      // at the right rim a name stands left of its mark
      const beyond = dx > 0 && x + dx + context.measureText(text).width > context.canvas.width;
      if (beyond) dx = -dx;
      context.textAlign = dx ? (beyond ? "right" : "left") : "center";
      context.lineWidth = 3;
      context.strokeStyle = "rgb(0 0 0 / 65%)";
      context.fillStyle = "#ffffff";
      context.strokeText(text, x + dx, y + dy);
      context.fillText(text, x + dx, y + dy);
    }
    marks() {
      if (!this.names) return;
      for (const source of this.sources) {
        const anchor = { z: Math.sin(radians(source.b)), longitude: radians(source.l) };
        this.ring(anchor.z, anchor.longitude, 5, "#ffffff");
        this.label(source.name, anchor, 9, 5, 14);
      }
    }
    ring(z, longitude, radius, colour) {
      const context = this.canvas.getContext("2d");
      const [x, y] = this.point(z, longitude);
      const growth = this.growth();
      for (const [width, style] of [[4, "#000000"], [2, colour]]) {
        context.beginPath();
        context.arc(x, y, radius * growth, 0, TURN);
        context.lineWidth = width * growth;
        context.strokeStyle = style;
        context.stroke();
      }
    }
    // hover(hit): moved over; choose(hit): clicked or tapped; draw(): to be drawn anew
    listen({ hover, choose, draw }) {
      const share = (event) => {
        const box = this.canvas.getBoundingClientRect();
        return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
      };
      let grip = null;
      let due = false;
      const soon = () => {
        if (due) return;
        due = true;
        requestAnimationFrame(() => { due = false; draw(); });
      };
      this.canvas.addEventListener("pointerdown", (event) => {
        const [x, y] = share(event);
        grip = { x, y, u: this.u, v: this.v, moved: false };
      });
      this.canvas.addEventListener("pointermove", (event) => {
        const [x, y] = share(event);
        hover(this.directionAt(x, y));
        if (!grip || !event.buttons) return;
        if (Math.hypot(x - grip.x, y - grip.y) > 0.01) grip.moved = true;
        if (!grip.moved || this.zoom === 1) return;
        this.move(grip.u - (x - grip.x) / this.zoom, grip.v - (y - grip.y) / this.zoom);
        soon();
      });
      this.canvas.addEventListener("click", (event) => {
        const hit = this.directionAt(...share(event));
        if (hit && !(grip && grip.moved)) choose(hit);
        grip = null;
      });
      this.canvas.addEventListener("dblclick", (event) => {
        this.scale(2, ...share(event));
        draw();
      });
      this.canvas.addEventListener("pointerleave", () => hover(null));
      this.canvas.addEventListener("wheel", (event) => {
        if (!event.ctrlKey && !event.metaKey) return;
        event.preventDefault();
        this.scale(event.deltaY < 0 ? 1.25 : 0.8, ...share(event));
        soon();
      }, { passive: false });
    }
  }
  // buttons that zoom, and choices of grid and names; centre(): where zooming keeps still, as place
  function controls(view, element, centre, draw) {
    const zoom = (factor) => {
      const { u, v } = centre();
      const seen = (coordinate, start) => (coordinate - start) * view.zoom;
      const [x, y] = [seen(u, view.u), seen(v, view.v)];
      const inside = x > 0 && x < 1 && y > 0 && y < 1;
      view.scale(factor, ...(inside ? [x, y] : [0.5, 0.5]));
      draw();
    };
    element("in").addEventListener("click", () => zoom(2));
    element("out").addEventListener("click", () => zoom(0.5));
    element("grid").addEventListener("change", (event) => {
      view.grid = event.target.value;
      draw();
    });
    element("names").addEventListener("change", (event) => {
      view.names = event.target.checked;
      draw();
    });
  }
  return {
    controls, bytes, floats, degrees, radians, pixelOf, place, equatorial, number, ticks, bar, View,
  };
})();
