"""Runs the scripts of a page in node, with a document that only keeps what is set."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

NODE = shutil.which("node")
# elements that remember; a canvas whose context keeps the last image
STUB = """
const elements = {};
function element(id) {
  if (elements[id]) return elements[id];
  const context = new Proxy({ measureText: (t) => ({ width: 7 * t.length }),
    createImageData: (w, h) => ({ data: new Uint8ClampedArray(4 * w * h), width: w, height: h }),
    putImageData(image) { elements[id].image = image; },
    fillText(text) { elements[id].texts.push(text); } },
    { get: (o, k) => (k in o ? o[k] : () => {}), set: () => true });
  const size = SIZES[id] || [400, 42];
  return (elements[id] = { id, width: size[0], height: size[1], textContent: "", value: "",
    texts: [], style: {}, options: [], listeners: {}, rows: [], getContext: () => context,
    add(o) { this.options.push(o); if (!this.value) this.value = o.value; },
    addEventListener(kind, f) { this.listeners[kind] = f; }, setAttribute() {},
    replaceChildren() { this.rows = []; }, append(...x) { this.rows.push(...x); },
    getBoundingClientRect: () => ({ left: 0, top: 0, width: size[0], height: size[1] }) });
}
globalThis.document = { getElementById: element, createElement: () => ({}) };
globalThis.Option = function (text, value) { this.text = text; this.value = value; };
globalThis.window = globalThis;
globalThis.requestAnimationFrame = (f) => f();
"""
SIZES = {"explorer-map": [400, 200], "explorer-psf": [120, 60]}


def run_page(page: str, tmp_path, commands: str) -> dict:
    """What ``commands`` leave in ``told`` after the scripts of the page have run."""
    (data,) = re.findall(
        r'<script type="application/json" id="explorer-data">(.*?)</script>', page, re.DOTALL
    )
    scripts = re.findall(r"<script>\n(.*?)\n</script>", page, re.DOTALL)
    text = "\n".join(
        [
            STUB.replace("SIZES", json.dumps(SIZES)),
            f"element('explorer-data').textContent = {json.dumps(data)};",
            *scripts,
            "const told = {};",
            commands,
            "require('fs').writeFileSync('told.json', JSON.stringify(told));",
        ]
    )
    (tmp_path / "page.js").write_text(text)
    subprocess.run([NODE, "page.js"], cwd=tmp_path, check=True, timeout=120)
    return json.loads((tmp_path / "told.json").read_text())
