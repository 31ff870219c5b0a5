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

  // y^T R of a direction
  function row(z, phi) {
    const y = sphere.harmonics(lmax, z, phi);
    const white = new Float64Array(n);
    for (let i = 0; i < n; i += 1) white[i] = y[i] * width[i];
    const resolved = new Float64Array(n);
    let k = 0;
    for (let i = 0; i < n; i += 1) {
      const ofEll = (lmax + 1) * ellOf[i];
      let sum = 0;
      for (let j = page.symmetric ? i : 0; j < n; j += 1, k += 1) {
        if (!packed[k]) continue;
        const value = packed[k] * steps[ofEll + ellOf[j]];
        if (page.symmetric) sum += value * white[j];
        if (j > i || !page.symmetric) resolved[j] += value * white[i];
      }
      resolved[i] += sum;
    }
    for (let i = 0; i < n; i += 1) resolved[i] = width[i] > 0 ? resolved[i] / width[i] : 0;
    return resolved;
  }
  // the kernel of a direction as a map of nside: per steradian
  return { kernel: (z, phi) => sphere.synthesis(row(z, phi), nside) };
}
