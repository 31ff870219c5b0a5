"use strict";
// Real spherical harmonics and HEALPix (RING): from coefficients to maps, and between pixels.
const sphere = (function () {
  // sin of the latitude, azimuth of the first pixel and number of pixels of each ring
  function rings(nside) {
    return Array.from({ length: 4 * nside - 1 }, (_, k) => {
      const ring = k + 1;
      if (ring < nside || ring > 3 * nside) {
        const cap = ring < nside ? ring : 4 * nside - ring;
        const z = 1 - (cap * cap) / (3 * nside * nside);
        return { z: ring < nside ? z : -z, first: Math.PI / (4 * cap), pixels: 4 * cap };
      }
      const first = (ring - nside) % 2 ? 0 : Math.PI / (4 * nside);
      return { z: 4 / 3 - (2 * ring) / (3 * nside), first, pixels: 4 * nside };
    });
  }

  // lambda_lm(theta), m >= 0: the harmonics at azimuth zero, with Condon and Shortley's sign
  function polar(lmax, z) {
    const sine = Math.sqrt(Math.max(0, 1 - z * z));
    const table = new Float64Array((lmax + 1) ** 2);
    let start = Math.sqrt(1 / (4 * Math.PI));
    for (let m = 0; m <= lmax; m += 1) {
      if (m) start *= -sine * Math.sqrt((2 * m + 1) / (2 * m));
      let [before, value] = [0, start];
      for (let l = m; l <= lmax; l += 1) {
        if (l > m) {
          const a = Math.sqrt((4 * l * l - 1) / (l * l - m * m));
          const b = l - 1 > m ? Math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1)) : 0;
          [before, value] = [value, a * (z * value - b * before)];
        }
        table[l * l + l + m] = value;
      }
    }
    return table;
  }

  // in one direction: -sqrt(2) sin |m| phi, 1, sqrt(2) cos m phi
  function harmonics(lmax, z, phi) {
    const y = polar(lmax, z);
    for (let l = 0; l <= lmax; l += 1) {
      for (let m = 1; m <= l; m += 1) {
        const value = y[l * l + l + m] * Math.SQRT2;
        y[l * l + l + m] = value * Math.cos(m * phi);
        y[l * l + l - m] = -value * Math.sin(m * phi);
      }
    }
    return y;
  }

  // the map of coefficients at l^2 + l + m
  function synthesis(modes, nside) {
    const lmax = Math.round(Math.sqrt(modes.length)) - 1;
    const pixels = new Float32Array(12 * nside * nside);
    let pixel = 0;
    for (const ring of rings(nside)) {
      const table = polar(lmax, ring.z);
      const [even, odd] = [new Float64Array(lmax + 1), new Float64Array(lmax + 1)];
      for (let l = 0; l <= lmax; l += 1) {
        const middle = l * l + l;
        even[0] += modes[middle] * table[middle];
        for (let m = 1; m <= l; m += 1) {
          const value = Math.SQRT2 * table[middle + m];
          even[m] += modes[middle + m] * value;
          odd[m] -= modes[middle - m] * value;
        }
      }
      for (let p = 0; p < ring.pixels; p += 1, pixel += 1) {
        const angle = ring.first + (2 * Math.PI * p) / ring.pixels;
        const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
        let [sum, c, s] = [even[0], 1, 0];
        for (let m = 1; m <= lmax; m += 1) {
          [c, s] = [c * cosine - s * sine, s * cosine + c * sine];
          sum += even[m] * c + odd[m] * s;
        }
        pixels[pixel] = sum;
      }
    }
    return pixels;
  }

  // a map between its pixels, as a function of z and azimuth: bilinear in colatitude and azimuth, at
  // the poles the mean of the ring beside
  function between(values, nside) {
    const of = rings(nside);
    const starts = [0];
    for (const ring of of) starts.push(starts[starts.length - 1] + ring.pixels);
    const thetas = of.map((ring) => Math.acos(ring.z));
    const last = of.length - 1;
    const along = (k, phi) => {
      const { first, pixels } = of[k];
      const place = ((phi - first) / (2 * Math.PI)) * pixels;
      const p = Math.floor(place);
      const value = (q) => values[starts[k] + (((q % pixels) + pixels) % pixels)];
      return value(p) + (place - p) * (value(p + 1) - value(p));
    };
    const pole = (k) => [0, 1, 2, 3].reduce((sum, p) => sum + values[starts[k] + p] / 4, 0);
    return (z, phi) => {
      const theta = Math.acos(z);
      let [low, high] = [0, last + 1];
      while (low < high) {
        const middle = (low + high) >> 1;
        if (thetas[middle] <= theta) low = middle + 1;
        else high = middle;
      }
      const north = low ? along(low - 1, phi) : pole(0);
      const south = low <= last ? along(low, phi) : pole(last);
      const from = low ? thetas[low - 1] : 0;
      const to = low <= last ? thetas[low] : Math.PI;
      return north + ((theta - from) / (to - from)) * (south - north);
    };
  }
  // a function of z and azimuth at the centres of pixels
  function sampled(f, nside) {
    const pixels = new Float32Array(12 * nside * nside);
    let pixel = 0;
    for (const ring of rings(nside)) {
      for (let p = 0; p < ring.pixels; p += 1, pixel += 1) {
        pixels[pixel] = f(ring.z, ring.first + (2 * Math.PI * p) / ring.pixels);
      }
    }
    return pixels;
  }

  return { harmonics, synthesis, between, sampled };
})();
