// A document whose elements remember what is set; a canvas whose context keeps the last image.
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
const parts = [0, 1, 2].map((k) => ({ dataset: { channel: String(k) }, hidden: k > 0 }));
const selectors = [element("first"), element("second")];
globalThis.document = { getElementById: element, createElement: () => ({}),
  querySelectorAll: (of) => (of === "select.channel" ? selectors : parts) };
globalThis.Option = function (text, value) { this.text = text; this.value = value; };
globalThis.window = globalThis;
globalThis.requestAnimationFrame = (f) => f();
