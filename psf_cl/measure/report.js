"use strict";
// The pictures of a report: decoded once, shown with any exposure, side by side or as differences.
(async () => {
  const byId = (id) => document.getElementById(id);
  const { width, height, pictures } = JSON.parse(byId("pictures").textContent);
  const [leftBox, rightBox, modeBox, zoomBox, exposureBox] =
    ["left", "right", "mode", "zoom", "exposure"].map(byId);
  const view = byId("view");
  let split = 0.5;
  let flipped = false;

  // The upper half of the PNG holds red, green, blue; the lower half the exponent that they share.
  async function decode(source) {
    const image = new Image();
    image.src = source;
    await image.decode();
    const canvas = document.createElement("canvas");
    canvas.width = width;
    canvas.height = 2 * height;
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0);
    const bytes = context.getImageData(0, 0, width, 2 * height).data;
    const values = new Float32Array(3 * width * height);
    for (let i = 0; i < width * height; ++i) {
      const exponent = bytes[4 * (i + width * height)];
      const scale = exponent === 255 ? NaN : exponent === 0 ? 0 : 2 ** (exponent - 128) / 255;
      for (let c = 0; c < 3; ++c)
        values[3 * i + c] = bytes[4 * i + c] * scale;
    }
    return values;
  }

  // The curve of tone_map in psf_cl/image.py.
  function toneMap(values, gain, out) {
    const knee = 0.8, desaturation = 0.15;
    for (let i = 0; i < width * height; ++i) {
      let r = values[3 * i] * gain, g = values[3 * i + 1] * gain, b = values[3 * i + 2] * gain;
      const peak = Math.max(r, g, b);
      if (!(peak < Infinity)) {
        out.set([255, 0, 255, 255], 4 * i);
        continue;
      }
      if (peak > knee) {
        const newPeak = 1 - (1 - knee) ** 2 / (peak + 1 - 2 * knee);
        const whiteness = 1 - 1 / (desaturation * (peak - newPeak) + 1);
        const scale = newPeak / peak;
        [r, g, b] = [r, g, b].map((v) => v * scale + (newPeak - v * scale) * whiteness);
      }
      out[4 * i] = encode(r);
      out[4 * i + 1] = encode(g);
      out[4 * i + 2] = encode(b);
      out[4 * i + 3] = 255;
    }
  }

  function encode(v) {
    return Math.round(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));
  }

  function luminance(values, i) {
    return 0.2126 * values[3 * i] + 0.7152 * values[3 * i + 1] + 0.0722 * values[3 * i + 2];
  }

  // As difference_picture in psf_cl/cli/compare.py.
  function difference(values, reference, out) {
    let mean = 0;
    for (let i = 0; i < width * height; ++i)
      mean += luminance(reference, i) / (width * height);
    for (let i = 0; i < width * height; ++i) {
      const x = luminance(values, i), r = luminance(reference, i);
      const amount = (x - r) / Math.sqrt(r * r + 0.01 * mean * mean) / 0.5;
      if (!isFinite(amount)) {
        out.set([0, 255, 0, 255], 4 * i);
        continue;
      }
      const red = 1 - Math.min(Math.max(-amount, 0), 1), blue = 1 - Math.min(Math.max(amount, 0), 1);
      out.set([255 * red, 255 * Math.min(red, blue), 255 * blue, 255], 4 * i);
    }
  }

  function picture(index) {
    const data = new ImageData(width, height);
    if (modeBox.value === "difference")
      difference(decoded[index], decoded[0], data.data);
    else
      toneMap(decoded[index], 2 ** exposureBox.value, data.data);
    return data;
  }

  function drawView() {
    const context = view.getContext("2d");
    const [left, right] = [+leftBox.value, +rightBox.value];
    const single = modeBox.value === "flip";
    const at = single ? (flipped ? 0 : width) : Math.round(split * width);
    if (at > 0)
      context.putImageData(picture(left), 0, 0, 0, 0, at, height);
    if (at < width)
      context.putImageData(picture(right), 0, 0, at, 0, width - at, height);
    byId("handle").style.left = `${100 * at / width}%`;
    byId("handle").style.display = single ? "none" : "block";
    const names = [pictures[left].label, pictures[right].label];
    byId("caption").textContent = single ? names[+flipped] : names.join("   |   ");
  }

  function drawAll() {
    byId("exposure-value").textContent = `${(+exposureBox.value).toFixed(2)} EV`;
    view.style.width = `${width * zoomBox.value}px`;
    drawView();
    document.querySelectorAll("#strip canvas").forEach((canvas) => {
      canvas.getContext("2d").putImageData(picture(+canvas.dataset.index), 0, 0);
    });
  }

  const decoded = await Promise.all(pictures.map((one) => decode(one.source)));
  view.width = width;
  view.height = height;
  pictures.forEach((one, index) => {
    for (const box of [leftBox, rightBox])
      box.add(new Option(one.label, index));
    const canvas = document.createElement("canvas");
    canvas.width = width;
    canvas.height = height;
    canvas.dataset.index = index;
    const caption = document.createElement("figcaption");
    caption.textContent = one.label;
    const box = document.createElement("figure");
    if (one.column)
      box.style.gridColumn = one.column;
    box.append(canvas, caption);
    box.onclick = (event) => {
      (event.shiftKey ? rightBox : leftBox).value = index;
      drawView();
    };
    byId("strip").append(box);
  });
  leftBox.value = pictures.length > 1 ? 1 : 0;
  rightBox.value = 0;
  zoomBox.value = [4, 2, 1].find((zoom) => zoom * width <= 1024) ?? 1;

  for (const box of [leftBox, rightBox, modeBox, zoomBox])
    box.onchange = drawAll;
  exposureBox.oninput = drawAll;
  const slide = (event) => {
    const place = view.getBoundingClientRect();
    split = Math.min(Math.max((event.clientX - place.left) / place.width, 0), 1);
    drawView();
  };
  byId("viewer").onpointerdown = (event) => {
    byId("viewer").setPointerCapture(event.pointerId);
    if (modeBox.value === "flip")
      flipped = !flipped;
    slide(event);
  };
  byId("viewer").onpointermove = (event) => event.buttons && modeBox.value !== "flip" && slide(event);
  document.onkeydown = (event) => {
    if (event.key === " " && modeBox.value === "flip") {
      event.preventDefault();
      flipped = !flipped;
      drawView();
    }
  };
  drawAll();
  document.body.dataset.ready = pictures.length;
})();
