"use strict";
// The layer that is shown, as a picture with its colours and as a HEALPix map.
const downloads = (function () {
  function save(blob, name) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    URL.revokeObjectURL(link.href);
  }

  // map and colour bar below a title
  function picture(map, bar, title, name) {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [map.width, map.height + 100];
    const context = canvas.getContext("2d");
    context.fillStyle = "#ffffff";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = "#1b1b1b";
    context.font = "20px system-ui, sans-serif";
    context.textAlign = "center";
    context.fillText(title, canvas.width / 2, 30);
    context.drawImage(map, 0, 44);
    context.drawImage(bar, (canvas.width - bar.width) / 2, map.height + 54);
    canvas.toBlob((blob) => save(blob, name));
  }

  // a FITS file: cards of 80 characters and big-endian numbers in blocks of 2880 bytes
  function fits(values, nside, title, unit) {
    const card = (key, value, comment) => {
      const text = typeof value === "string" ? `'${value.padEnd(8)}'` : String(value).padStart(20);
      return `${key.padEnd(8)}= ${typeof value === "boolean" ? (value ? "T" : "F").padStart(20)
        : text}${comment ? ` / ${comment}` : ""}`.padEnd(80);
    };
    const header = (cards) => {
      const text = [...cards, "END".padEnd(80)].join("");
      return new TextEncoder().encode(text.padEnd(2880 * Math.ceil(text.length / 2880)));
    };
    const primary = header([
      card("SIMPLE", true), card("BITPIX", 8), card("NAXIS", 0), card("EXTEND", true)]);
    const table = header([
      card("XTENSION", "BINTABLE"), card("BITPIX", 8), card("NAXIS", 2), card("NAXIS1", 4),
      card("NAXIS2", values.length), card("PCOUNT", 0), card("GCOUNT", 1), card("TFIELDS", 1),
      card("TTYPE1", "MAP", title), card("TFORM1", "E"), card("TUNIT1", unit),
      card("PIXTYPE", "HEALPIX"), card("ORDERING", "RING"), card("COORDSYS", "G"),
      card("NSIDE", nside), card("FIRSTPIX", 0), card("LASTPIX", values.length - 1),
      card("INDXSCHM", "IMPLICIT"), card("OBJECT", "FULLSKY")]);
    const body = new DataView(new ArrayBuffer(2880 * Math.ceil((4 * values.length) / 2880)));
    values.forEach((value, k) => body.setFloat32(4 * k, value));
    return [primary, table, new Uint8Array(body.buffer)];
  }

  return { save, picture, fits };
})();
