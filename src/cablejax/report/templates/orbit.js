// Plays cables in space and lets them be turned: drag to turn, wheel to zoom. The data is inlined by spatial_figures.py.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("cables").textContent);
  const canvas = document.getElementById("orbit");
  const slider = document.getElementById("orbit-time");
  const clock = document.getElementById("orbit-clock");
  const button = document.getElementById("orbit-play");
  const choice = document.getElementById("orbit-window");
  const METRES = 1e-3; // coordinates travel as whole millimetres
  let yaw = -0.7, pitch = 0.35, zoom = 1, current = 0, playing = false, last = null, grip = null;

  document.getElementById("orbit-player").hidden = false;
  data.windows.forEach((w, i) => choice.add(new Option(w.name, i)));
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

  /** A point of the room on the canvas: turned about the vertical, then tilted. */
  function project(p, middle, scale, width, height) {
    const x = p[0] * METRES - middle[0], y = p[1] * METRES - middle[1], z = p[2] * METRES - middle[2];
    const across = x * Math.cos(yaw) - y * Math.sin(yaw);
    const depth = x * Math.sin(yaw) + y * Math.cos(yaw);
    const up = z * Math.cos(pitch) - depth * Math.sin(pitch);
    return [width / 2 + across * scale, height / 2 - up * scale];
  }

  function draw() {
    const shown = data.windows[current];
    const width = canvas.clientWidth, height = Math.round(width * 0.62), ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    canvas.style.height = height + "px";
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineJoin = pen.lineCap = "round";
    const k = Math.min(Math.round(+slider.value / data.interval), shown.observed.length - 1);
    const scale = (zoom * Math.min(width, height * 1.3)) / (1.5 * shown.reach);
    const at = (p) => project(p, shown.middle, scale, width, height);
    // a grid on the floor below the cable
    pen.strokeStyle = colour("faint");
    pen.lineWidth = 1;
    for (let i = -4; i <= 4; i++) {
      for (const flip of [false, true]) {
        pen.beginPath();
        for (const j of [-4, 4]) {
          const a = (flip ? j : i) * 100, b = (flip ? i : j) * 100;
          pen.lineTo(...at([shown.middle[0] * 1e3 + a, shown.middle[1] * 1e3 + b, shown.floor]));
        }
        pen.stroke();
      }
    }
    const line = (name, style, wide, dash) => {
      if (!shown[name]) return;
      pen.strokeStyle = colour(style);
      pen.lineWidth = wide;
      pen.setLineDash(dash);
      pen.beginPath();
      for (const p of shown[name][k]) if (p) pen.lineTo(...at(p));
      pen.stroke();
      pen.setLineDash([]);
    };
    line("nominal", "direct", 2.5, [8, 6]);
    line("explained", "residual", 3.5, []);
    pen.fillStyle = colour("ink");
    for (const p of shown.observed[k]) {
      if (!p) continue;
      pen.beginPath();
      pen.arc(...at(p), 4.5, 0, 2 * Math.PI);
      pen.fill();
    }
    clock.textContent = (k * data.interval).toFixed(1) + " s";
  }

  function tick(now) {
    if (!playing) return;
    if (last !== null) {
      const next = +slider.value + (now - last) / 1000;
      slider.value = next > +slider.max ? 0 : next;
    }
    last = now;
    draw();
    requestAnimationFrame(tick);
  }
  function select() {
    current = +choice.value;
    slider.max = (data.windows[current].observed.length - 1) * data.interval;
    slider.value = data.windows[current].shown * data.interval;
    draw();
  }
  button.onclick = () => {
    playing = !playing;
    last = null;
    button.textContent = playing ? "Pause" : "Play";
    if (playing) requestAnimationFrame(tick);
  };
  slider.oninput = draw;
  choice.onchange = select;
  canvas.onpointerdown = (event) => {
    grip = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  };
  canvas.onpointermove = (event) => {
    if (!grip) return;
    yaw += (event.clientX - grip[0]) * 0.01;
    pitch = Math.max(-1.5, Math.min(1.5, pitch + (event.clientY - grip[1]) * 0.01));
    grip = [event.clientX, event.clientY];
    draw();
  };
  canvas.onpointerup = canvas.onpointercancel = () => (grip = null);
  canvas.onwheel = (event) => {
    event.preventDefault();
    zoom = Math.max(0.3, Math.min(6, zoom * Math.exp(-event.deltaY * 0.001)));
    draw();
  };
  window.addEventListener("resize", draw);
  select();
})();
