// The points of a reconstruction below the radar, and beside them the SAR images from there (widget.py makes the data).
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("widget-data").textContent);
  const byId = (name) => document.getElementById(name);
  const stage = byId("stage"), cloud = byId("cloud");
  const inputs = { azimuth: byId("azimuth"), depth: byId("depth") };
  const climbs = byId("grazing") !== null;      // directions of one grazing angle have no slider for it
  if (climbs) inputs.grazing = byId("grazing");
  const state = { azimuth: data.start[0], grazing: data.start[1] };

  const CAMERA_ASIDE = 50, CAMERA_UP = 24;      // where the reader looks from, degrees from the radar and above the horizon
  const DEGREES_PER_PIXEL = 0.5, DEGREES_PER_KEY = 5;
  const DOME = 1.25;                            // its radius in half diagonals of the target
  const [LOWEST, HIGHEST] = data.grazing;       // of the directions that there are images from
  const RINGS = [0, 30, 60].filter((grazing) => grazing === 0 || grazing < HIGHEST);

  // ---- directions: azimuth clockwise from x seen from above, grazing above the horizon ----------------------------
  const radians = (degrees) => degrees * Math.PI / 180;
  function direction(azimuth, grazing) {
    const a = radians(azimuth), g = radians(grazing);
    return [Math.cos(g) * Math.cos(a), -Math.cos(g) * Math.sin(a), Math.sin(g)];
  }
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const directions = data.views.map((view) => direction(...view));
  function nearest(count) {
    const here = direction(state.azimuth, state.grazing);
    let best = 0;
    for (let k = 1; k < count; k++) if (dot(here, directions[k]) > dot(here, directions[best])) best = k;
    return [best, Math.acos(Math.min(1, dot(here, directions[best]))) * 180 / Math.PI];
  }

  // ---- the points, metres ------------------------------------------------------------------------------------------
  const packed = Uint8Array.from(atob(data.points), (c) => c.charCodeAt(0));
  const count = packed.length / 6;
  const centre = [0, 1, 2].map((k) => (data.low[k] + data.high[k]) / 2);
  const extent = [0, 1, 2].map((k) => data.high[k] - data.low[k]);
  const radius = Math.hypot(...extent) / 2 || 1;
  const points = new Float32Array(3 * count), shade = new Uint8Array(count);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
      const share = (packed[6 * i + 2 * k] + 256 * packed[6 * i + 2 * k + 1]) / 65535;
      points[3 * i + k] = (share - 0.5) * extent[k];
      if (k === 2) shade[i] = 255 * share;
    }
  }

  // ---- the cloud, drawn with a depth buffer ------------------------------------------------------------------------
  function camera() {
    const towards = direction(state.azimuth - CAMERA_ASIDE, CAMERA_UP);
    const a = radians(state.azimuth - CAMERA_ASIDE);
    const right = [Math.sin(a), Math.cos(a), 0];
    const up = [towards[1] * right[2] - towards[2] * right[1], towards[2] * right[0] - towards[0] * right[2],
      towards[0] * right[1] - towards[1] * right[0]];
    return { towards, right, up };
  }
  // how far all that is drawn reaches above and below the foot of the dome, in its radii
  const above = Math.max(...[...RINGS, HIGHEST].map((grazing) => Math.sin(radians(Math.min(grazing + CAMERA_UP, 90)))));
  const below = Math.sin(radians(CAMERA_UP));
  stage.style.aspectRatio = Math.min(Math.max(2 / (above + below), 1.2), 1.6);
  let placed = [];  // where the dots of the views are on the screen, for clicks
  const layer = document.createElement("canvas");
  function drawCloud() {
    const box = stage.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = cloud.width = Math.max(1, Math.round(box.width * ratio));
    const height = cloud.height = Math.max(1, Math.round(box.height * ratio));
    const context = cloud.getContext("2d"), eye = camera();
    const reach = DOME * radius, ground = -extent[2] / 2, room = 24 * ratio;  // for the radar's label and the dots
    const scale = Math.min((width - room) / 2, (height - 2 * room) / (above + below)) / reach;
    const foot = room + (height - 2 * room + scale * reach * (above - below)) / 2;
    const middle = [width / 2, foot + scale * ground * eye.up[2]];
    const project = (p) => [middle[0] + scale * dot(p, eye.right), middle[1] - scale * dot(p, eye.up), dot(p, eye.towards)];

    const picture = context.createImageData(width, height), pixels = new Uint32Array(picture.data.buffer);
    const depth = new Float32Array(width * height).fill(-Infinity);
    const size = Math.max(2, Math.round(2.2 * scale * radius / Math.sqrt(count)));
    const colours = data.heightColours.map(([r, g, b]) => 0xff000000 | (b << 16) | (g << 8) | r);
    for (let i = 0; i < count; i++) {
      const [x, y, z] = project([points[3 * i], points[3 * i + 1], points[3 * i + 2]]);
      const left = Math.round(x - size / 2), top = Math.round(y - size / 2);
      for (let v = Math.max(top, 0); v < Math.min(top + size, height); v++)
        for (let u = Math.max(left, 0); u < Math.min(left + size, width); u++) {
          const at = v * width + u;
          if (z > depth[at]) { depth[at] = z; pixels[at] = colours[shade[i]]; }
        }
    }
    layer.width = width; layer.height = height;
    layer.getContext("2d").putImageData(picture, 0, 0);

    const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
    const onDome = (azimuth, grazing) => direction(azimuth, grazing).map((c, k) => reach * c + (k === 2 ? ground : 0));
    context.lineWidth = ratio;
    context.strokeStyle = colour("--line");
    for (const grazing of RINGS) {
      context.beginPath();
      for (let a = 0; a <= 360; a += 5) context.lineTo(...project(onDome(a, grazing)).slice(0, 2));
      context.stroke();
    }
    const dots = data.dots.map(([azimuth, grazing, test]) => [...project(onDome(azimuth, grazing)), azimuth, grazing, test]);
    const dotRadius = Math.max(1.6, Math.min(3, 40 / Math.sqrt(dots.length))) * ratio;
    const drawDots = (front) => {
      context.globalAlpha = front ? 1 : 0.35;
      for (const [x, y, z, , , test] of dots) {
        if ((z >= 0) !== front) continue;
        context.fillStyle = colour(test ? "--second" : "--accent");
        context.beginPath(); context.arc(x, y, dotRadius, 0, 7); context.fill();
      }
    };
    drawDots(false);
    context.globalAlpha = 1;
    context.drawImage(layer, 0, 0);  // the target hides what is behind it
    drawDots(true);
    placed = dots.map(([x, y, , azimuth, grazing]) => [x / ratio, y / ratio, azimuth, grazing]);
    arrow(context, project(onDome(state.azimuth, state.grazing)), project([0, 0, ground]), colour, ratio);
    scaleBar(scale / ratio, box.width);
  }
  function arrow(context, from, to, colour, ratio) {
    const end = [from[0] + 0.45 * (to[0] - from[0]), from[1] + 0.45 * (to[1] - from[1])];
    const angle = Math.atan2(to[1] - from[1], to[0] - from[0]), head = 11 * ratio;
    context.strokeStyle = context.fillStyle = colour("--radar");
    context.lineWidth = 2.5 * ratio;
    context.beginPath(); context.moveTo(from[0], from[1]); context.lineTo(end[0], end[1]); context.stroke();
    context.beginPath(); context.moveTo(end[0] + head * Math.cos(angle), end[1] + head * Math.sin(angle));
    for (const side of [2.6, -2.6]) context.lineTo(end[0] + head * Math.cos(angle + side), end[1] + head * Math.sin(angle + side));
    context.fill();
    context.beginPath(); context.arc(from[0], from[1], 5 * ratio, 0, 7); context.fill();
    context.font = `600 ${13 * ratio}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.strokeStyle = colour("--card");
    context.lineWidth = 4 * ratio;
    context.fillStyle = colour("--ink");
    context.strokeText("radar", from[0], from[1] - 11 * ratio);
    context.fillText("radar", from[0], from[1] - 11 * ratio);
  }
  function scaleBar(pixelsPerMetre, width) {
    const most = width / 4 / pixelsPerMetre, power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((k) => k * power).find((k) => k <= most * 1.000001);
    byId("cloud-scale").style.width = `${length * pixelsPerMetre}px`;
    byId("cloud-scale").textContent = length >= 1 ? `${length} m` : `${+(100 * length).toPrecision(1)} cm`;
  }

  // ---- the images --------------------------------------------------------------------------------------------------
  const sheets = {};
  function load(name) {
    return new Promise((done) => {
      const image = new Image();
      image.onload = () => {
        const canvas = document.createElement("canvas");
        canvas.width = image.width; canvas.height = image.height;
        const context = canvas.getContext("2d", { willReadFrequently: true });
        context.drawImage(image, 0, 0);
        sheets[name] = { context, across: data[name].across };
        done();
      };
      image.src = data[name].uri;
    });
  }
  function show(canvasName, sheet, index, colour) {
    const canvas = byId(canvasName), { context, across } = sheets[sheet];
    canvas.width = data.columns; canvas.height = data.rows;
    const left = (index % across) * data.columns, top = Math.floor(index / across) * data.rows;
    const picture = context.getImageData(left, top, data.columns, data.rows);
    for (let at = 0; at < picture.data.length; at += 4) {
      const [r, g, b, a] = colour[picture.data[at]];
      picture.data[at] = r; picture.data[at + 1] = g; picture.data[at + 2] = b; picture.data[at + 3] = a;
    }
    canvas.getContext("2d").putImageData(picture, 0, 0);
  }
  const words = ([azimuth, grazing]) => `azimuth ${+azimuth.toFixed(1)}°, grazing ${+grazing.toFixed(1)}°`;
  function drawImages() {
    const depth = Number(inputs.depth.value), ramp = data.powerColours[byId("colours").value];
    const colour = Array.from({ length: 256 }, (_, code) => {
      const decibels = data.deepest * (code / data.levels - 1);
      return [...ramp[Math.round(255 * Math.min(Math.max(1 + decibels / depth, 0), 1))], 255];
    });
    const [rendered] = nearest(data.views.length), [known, away] = nearest(data.sets.length);
    show("sar-rendered", "rendered", rendered, colour);
    show("sar-true", "true", known, colour);
    show("sar-error", "errors", known, data.errorColours);
    byId("sar-rendered-title").textContent = `reconstruction, ${words(data.views[rendered])}`;
    byId("sar-true-title").textContent =
      `${data.name}, ${words(data.views[known])} (${data.sets[known]}; ${away.toFixed(0)}° away)`;
    byId("sar-error-title").textContent = `error at the view of the ${data.name} image`;
    const bar = byId("power-bar").querySelector(".ramp"), ticks = [...bar.querySelectorAll(".tick")];
    const stops = ramp.filter((_, index) => index % 17 === 0);
    bar.style.backgroundImage = `linear-gradient(90deg, ${stops.map((c) => `rgb(${c.join(" ")})`).join(", ")})`;
    ticks.forEach((tick, index) => {
      const level = depth * (index / (ticks.length - 1) - 1);
      tick.textContent = level ? `−${+(-level).toFixed(1)}` : "0";
    });
  }

  // ---- what the reader does ----------------------------------------------------------------------------------------
  let asked = false;
  function draw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      for (const name of ["azimuth", "grazing"]) if (inputs[name]) inputs[name].value = state[name];
      for (const name in inputs)
        document.querySelector(`output[for=${name}]`).textContent =
          name === "depth" ? `${inputs.depth.value} dB` : `${state[name].toFixed(1)}°`;
      drawCloud();
      drawImages();
    });
  }
  function move(azimuth, grazing) {
    state.azimuth = (azimuth % 360 + 360) % 360;
    state.grazing = Math.min(HIGHEST, Math.max(LOWEST, grazing));
    draw();
  }
  let grip = null;
  stage.addEventListener("pointerdown", (event) => {
    grip = { x: event.clientX, y: event.clientY, azimuth: state.azimuth, grazing: state.grazing };
    stage.setPointerCapture(event.pointerId);
  });
  stage.addEventListener("pointermove", (event) => {
    if (!grip) return;
    const climb = climbs ? DEGREES_PER_PIXEL * (grip.y - event.clientY) : 0;
    move(grip.azimuth + DEGREES_PER_PIXEL * (event.clientX - grip.x), grip.grazing + climb);
  });
  stage.addEventListener("pointerup", (event) => {
    if (grip && Math.hypot(event.clientX - grip.x, event.clientY - grip.y) < 4) {  // a click: go to the view there
      const box = stage.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
      const hit = placed.map((p) => [Math.hypot(p[0] - x, p[1] - y), p]).sort((a, b) => a[0] - b[0])[0];
      if (hit && hit[0] < 12) move(hit[1][2], hit[1][3]);
    }
    grip = null;
  });
  stage.addEventListener("pointercancel", () => { grip = null; });
  stage.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!steps || (steps[1] && !climbs)) return;
    event.preventDefault();
    move(state.azimuth + DEGREES_PER_KEY * steps[0], state.grazing + DEGREES_PER_KEY * steps[1]);
  });
  inputs.azimuth.addEventListener("input", () => move(Number(inputs.azimuth.value), state.grazing));
  if (climbs) inputs.grazing.addEventListener("input", () => move(state.azimuth, Number(inputs.grazing.value)));
  inputs.depth.addEventListener("input", draw);
  byId("colours").addEventListener("input", draw);
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  Promise.all(["rendered", "true", "errors"].map(load)).then(draw);
})();
