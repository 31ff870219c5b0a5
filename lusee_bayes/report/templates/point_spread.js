"use strict";
// Point-spread functions of any direction: y^T R, R = D K D^-1, D the prior's widths.
function pointSpread(page) {
  const { lmax, nside } = page;
  const n = (lmax + 1) ** 2;
  // K row by row, of a symmetric one the upper triangle, in steps of its block of multipoles
  const packed = new Int8Array(skyView.bytes(page.entries).buffer);
  const steps = skyView.floats(page.steps);
  const width = skyView.floats(page.prior_std);
  const ellOf = Int32Array.from({ length: n }, (_, k) => Math.floor(Math.sqrt(k)));

  // lambda_lm(theta), m >= 0: the harmonics at azimuth zero, with Condon and Shortley's sign
  function polar(z) {
    const sine = Math.sqrt(Math.max(0, 1 - z * z));
    const found = new Float64Array(n);
    let start = Math.sqrt(1 / (4 * Math.PI));
    for (let m = 0; m <= lmax; m += 1) {
      if (m) start *= -sine * Math.sqrt((2 * m + 1) / (2 * m));
      let [before, here] = [0, start];
      for (let l = m; l <= lmax; l += 1) {
        if (l > m) {
          const a = Math.sqrt((4 * l * l - 1) / (l * l - m * m));
          const b = l - 1 > m ? Math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1)) : 0;
          [before, here] = [here, a * (z * here - b * before)];
        }
        found[l * l + l + m] = here;
      }
    }
    return found;
  }
  // real harmonics: -sqrt(2) sin |m| phi, 1, sqrt(2) cos m phi
  function harmonics(z, phi) {
    const found = polar(z);
    for (let l = 0; l <= lmax; l += 1) {
      for (let m = 1; m <= l; m += 1) {
        const at = found[l * l + l + m] * Math.SQRT2;
        found[l * l + l + m] = at * Math.cos(m * phi);
        found[l * l + l - m] = -at * Math.sin(m * phi);
      }
    }
    return found;
  }
  // y^T R of a direction
  function row(z, phi) {
    const y = harmonics(z, phi);
    const white = new Float64Array(n);
    for (let i = 0; i < n; i += 1) white[i] = y[i] * width[i];
    const known = new Float64Array(n);
    let k = 0;
    for (let i = 0; i < n; i += 1) {
      const ofEll = (lmax + 1) * ellOf[i];
      let sum = 0;
      for (let j = page.symmetric ? i : 0; j < n; j += 1, k += 1) {
        if (!packed[k]) continue;
        const value = packed[k] * steps[ofEll + ellOf[j]];
        if (page.symmetric) sum += value * white[j];
        if (j > i || !page.symmetric) known[j] += value * white[i];
      }
      known[i] += sum;
    }
    for (let i = 0; i < n; i += 1) known[i] = width[i] > 0 ? known[i] / width[i] : 0;
    return known;
  }
  // rings of a HEALPix map: sin of the latitude, azimuth of the first pixel, number of pixels
  const rings = Array.from({ length: 4 * nside - 1 }, (_, k) => {
    const ring = k + 1;
    if (ring < nside || ring > 3 * nside) {
      const cap = ring < nside ? ring : 4 * nside - ring;
      const z = 1 - (cap * cap) / (3 * nside * nside);
      return { z: ring < nside ? z : -z, first: Math.PI / (4 * cap), pixels: 4 * cap };
    }
    const first = (ring - nside) % 2 ? 0 : Math.PI / (4 * nside);
    return { z: 4 / 3 - (2 * ring) / (3 * nside), first, pixels: 4 * nside };
  });
  let tables = null;
  // the kernel of a direction as a map of nside: per steradian
  function kernel(z, phi) {
    if (!tables) tables = rings.map((ring) => polar(ring.z));
    const weights = row(z, phi);
    const found = new Float32Array(12 * nside * nside);
    let pixel = 0;
    rings.forEach((ring, number) => {
      const table = tables[number];
      const [even, odd] = [new Float64Array(lmax + 1), new Float64Array(lmax + 1)];
      for (let l = 0; l <= lmax; l += 1) {
        const middle = l * l + l;
        even[0] += weights[middle] * table[middle];
        for (let m = 1; m <= l; m += 1) {
          const at = Math.SQRT2 * table[middle + m];
          even[m] += weights[middle + m] * at;
          odd[m] -= weights[middle - m] * at;
        }
      }
      for (let p = 0; p < ring.pixels; p += 1, pixel += 1) {
        const angle = ring.first + (2 * Math.PI * p) / ring.pixels;
        let sum = even[0];
        for (let m = 1; m <= lmax; m += 1) {
          sum += even[m] * Math.cos(m * angle) + odd[m] * Math.sin(m * angle);
        }
        found[pixel] = sum;
      }
    });
    return found;
  }
  return { harmonics, row, kernel };
}
