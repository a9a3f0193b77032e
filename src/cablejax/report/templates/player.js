// Plays the recorded runs: one canvas per shape, one slider for all. The data is inlined by page.py as JSON.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("runs").textContent);
  const player = document.getElementById("player");
  const slider = document.getElementById("time");
  const clock = document.getElementById("clock");
  const button = document.getElementById("play");
  const METRES = 1e-4; // coordinates travel as whole tenths of a millimetre
  const SPEED = 5; // seconds of the run per second of play
  const shown = { residual: true, direct: true };
  let playing = false;
  let last = null;

  player.hidden = false;
  slider.max = data.end;
  slider.value = data.end;

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

  /** Where `time` lies among the samples: [index below, index above, part of the way]. */
  function place(times, time) {
    let k = 0;
    while (k < times.length - 2 && times[k + 1] <= time) k++;
    if (times.length < 2) return [0, 0, 0];
    const part = (time - times[k]) / (times[k + 1] - times[k]);
    return [k, k + 1, Math.min(1, Math.max(0, part))];
  }
  const mix = (a, b, part) => a.map((v, i) => (v === null || b[i] === null ? null : v + part * (b[i] - v)));

  function drawPanel(panel, time) {
    const { canvas, shape } = panel;
    const [x0, x1, y0, y1] = data.view[shape.name];
    const width = canvas.clientWidth;
    const height = (width * (y1 - y0)) / (x1 - x0);
    const ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    const scale = width / (x1 - x0);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineCap = "round";
    pen.lineJoin = "round";
    const at = (x, y) => [(x - x0) * scale, (y1 - y) * scale];

    const line = (flat) => {
      pen.beginPath();
      for (let i = 0; i < flat.length; i += 2) {
        if (flat[i] !== null) pen.lineTo(...at(flat[i] * METRES, flat[i + 1] * METRES));
      }
      pen.stroke();
    };
    pen.strokeStyle = colour("target");
    pen.lineWidth = 3;
    pen.setLineDash([7, 7]);
    line(shape.target);
    pen.setLineDash([]);

    for (const run of shape.runs) {
      const reading = panel.readings[run.method];
      const [low, high, part] = place(run.times, time);
      reading.textContent = (run.error[low] + part * (run.error[high] - run.error[low])).toFixed(2);
      if (!shown[run.method]) continue;
      const strong = run.method === "residual" || !shown.residual || shape.runs.length === 1;
      const pose = mix(run.pose[low], run.pose[high], part);
      pen.fillStyle = colour("gripper");
      pen.globalAlpha = strong ? 1 : 0.35;
      data.gripper.forEach((polygons, end) => {
        const [x, y, theta] = pose.slice(3 * end, 3 * end + 3);
        for (const polygon of polygons) {
          pen.beginPath();
          for (const [a, b] of polygon) {
            const c = Math.cos(theta), s = Math.sin(theta);
            pen.lineTo(...at(x + c * a - s * b, y + s * a + c * b));
          }
          pen.fill();
        }
      });
      pen.globalAlpha = 1;
      pen.strokeStyle = pen.fillStyle = colour(run.method);
      pen.lineWidth = 3;
      line(mix(run.curve[low], run.curve[high], part));
      const points = mix(run.points[low], run.points[high], part);
      for (let i = 0; i < points.length; i += 2) {
        if (points[i] === null) continue;
        pen.beginPath();
        pen.arc(...at(points[i] * METRES, points[i + 1] * METRES), 2.6, 0, 2 * Math.PI);
        pen.fill();
      }
    }
    pen.strokeStyle = pen.fillStyle = colour("muted");
    pen.lineWidth = 1.5;
    pen.textAlign = "center";
    pen.font = "12px system-ui, sans-serif";
    pen.beginPath();
    const [bar, label] = data.bar;
    pen.moveTo(width - 4 - bar * scale, height - 6);
    pen.lineTo(width - 4, height - 6);
    pen.stroke();
    pen.fillText(label, width - 4 - (bar / 2) * scale, height - 11);
  }

  const panels = data.shapes.map((shape) => {
    const box = document.querySelector(`[data-shape="${CSS.escape(shape.name)}"]`);
    const readings = {};
    for (const run of shape.runs) readings[run.method] = box.querySelector(`[data-method="${run.method}"]`);
    return { shape, readings, canvas: box.querySelector("canvas") };
  });

  function draw() {
    const time = Number(slider.value);
    clock.textContent = time.toFixed(1) + " s";
    for (const panel of panels) drawPanel(panel, time);
  }

  function setPlaying(value) {
    playing = value;
    last = null;
    button.textContent = playing ? "Pause" : "Play";
    if (playing) requestAnimationFrame(tick);
  }

  // the slider stops at its last whole step
  function atEnd() {
    return Number(slider.value) > data.end - Number(slider.step);
  }

  function tick(now) {
    if (!playing) return;
    const passed = last === null ? 0 : (now - last) / 1000;
    last = now;
    slider.value = Math.min(data.end, Number(slider.value) + SPEED * passed);
    draw();
    if (atEnd()) setPlaying(false);
    else requestAnimationFrame(tick);
  }

  button.addEventListener("click", () => {
    if (!playing && atEnd()) slider.value = 0;
    setPlaying(!playing);
    draw();
  });
  slider.addEventListener("input", () => { setPlaying(false); draw(); });
  for (const box of document.querySelectorAll("[data-show]")) {
    box.addEventListener("change", () => { shown[box.dataset.show] = box.checked; draw(); });
  }
  window.addEventListener("resize", draw);
  window.addEventListener("beforeprint", () => { setPlaying(false); slider.value = data.end; draw(); });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
})();
