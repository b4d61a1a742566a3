// Views of moving bodies on plain canvases: drag turns, wheel zooms, Shift and drag moves. Each is
// a <div class="moving"> with its data as JSON. Triangles are drawn from the farthest to the
// nearest, shaded by their normal; no graphics card is asked for.
(() => {
  "use strict";
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const points = (part) => {
    const levels = new Uint16Array(bytes(part.levels).buffer), out = new Float32Array(levels.length);
    for (let i = 0; i < levels.length; i++) {
      out[i] = part.from[i % 3] + (levels[i] / 65535) * part.size[i % 3];
    }
    return out;
  };
  const shade = (color, light) => {
    const part = (k) => Math.min(255, Math.round(parseInt(color.slice(k, k + 2), 16) * light));
    return `rgb(${part(1)},${part(3)},${part(5)})`;
  };

  const BEGIN = { turn: -0.6, lift: 0.35 };

  class View {
    constructor(box) {
      this.box = box;
      const data = JSON.parse(box.querySelector("script").textContent);
      this.views = Array.isArray(data) ? data : [data];
      Object.assign(this, { ...BEGIN, zoom: 1, shift: [0, 0], frame: 0, playing: false });
      this.hidden = new Set();
      this.build();
      this.show(this.views[0]);
      new ResizeObserver(() => this.draw()).observe(this.canvas);
    }

    show(data) {
      this.stop();
      this.frame = 0;
      this.time = data.time;
      this.parts = data.parts.map((part) => ({
        ...part, shown: !this.hidden.has(part.name), at: points(part),
        triangles: part.triangles && (part.wide ? new Uint32Array(bytes(part.triangles).buffer)
          : new Uint16Array(bytes(part.triangles).buffer)),
        poses: part.poses && new Float32Array(bytes(part.poses).buffer),
        shades: Array.from({ length: 33 }, (_, k) => shade(part.color, 0.55 + (0.55 * k) / 32)),
      }));
      this.middle = data.low.map((v, k) => 0.5 * (v + data.high[k]));
      this.floor = data.low[2];
      this.reach = 0.5 * Math.hypot(...data.low.map((v, k) => data.high[k] - v)) || 1;
      this.fit(data.low, data.high);
      this.slider.max = this.time.length - 1;
      this.partButtons();
      this.draw();
    }

    // how far the box of all that moves reaches to the side and upwards, from where a view begins
    fit(low, high) {
      const at = [], own = { turn: this.turn, lift: this.lift };
      for (let k = 0; k < 8; k++) at.push(...low.map((v, i) => ((k >> i) & 1 ? high[i] : v)));
      Object.assign(this, BEGIN);
      const c = this.placed({ kind: "line", at });
      Object.assign(this, own);
      this.aside = this.above = 0.05 * this.reach;
      for (let i = 0; i < c.length; i += 3) {
        const near = (4 * this.reach) / (4 * this.reach - c[i + 2]);
        this.aside = Math.max(this.aside, Math.abs(c[i]) * near);
        this.above = Math.max(this.above, Math.abs(c[i + 1]) * near);
      }
    }

    build() {
      this.canvas = document.createElement("canvas");
      this.canvas.setAttribute("role", "img");
      this.canvas.setAttribute("aria-label", "moving view; drag to turn");
      const bar = document.createElement("div");
      bar.className = "moving-bar";
      this.play = document.createElement("button");
      this.play.type = "button";
      this.slider = Object.assign(document.createElement("input"),
        { type: "range", min: 0, max: 1, value: 0 });
      this.slider.setAttribute("aria-label", "time");
      this.clock = document.createElement("span");
      if (this.views.length > 1) bar.append(this.menu());
      bar.append(this.play, this.slider, this.clock);
      this.bar = bar;
      this.box.append(this.canvas, bar);
      this.play.onclick = () => (this.playing ? this.stop() : this.start());
      this.slider.oninput = () => { this.stop(); this.frame = Number(this.slider.value); this.draw(); };
      this.canvas.onpointerdown = (e) => this.canvas.setPointerCapture(e.pointerId);
      this.canvas.onpointermove = (e) => this.drag(e);
      this.canvas.addEventListener("wheel", (e) => {
        e.preventDefault();
        this.zoom = Math.min(20, Math.max(0.2, this.zoom * Math.exp(-0.0015 * e.deltaY)));
        this.draw();
      }, { passive: false });
      this.canvas.ondblclick = () => {
        Object.assign(this, { ...BEGIN, zoom: 1, shift: [0, 0] });
        this.draw();
      };
      this.label();
    }

    menu() {
      const menu = document.createElement("select");
      menu.setAttribute("aria-label", "run");
      for (const view of this.views) menu.append(new Option(view.name));
      menu.onchange = () => this.show(this.views[menu.selectedIndex]);
      return menu;
    }

    partButtons() {
      for (const old of this.bar.querySelectorAll(".moving-part")) old.remove();
      for (const name of new Set(this.parts.map((part) => part.name))) {
        const own = this.parts.filter((part) => part.name === name);
        const button = document.createElement("button");
        Object.assign(button, { type: "button", className: "moving-part", textContent: name });
        button.style.setProperty("--part", own[0].color);
        button.setAttribute("aria-pressed", String(own[0].shown));
        button.onclick = () => {
          for (const part of own) part.shown = !part.shown;
          this.hidden[own[0].shown ? "delete" : "add"](name);
          button.setAttribute("aria-pressed", String(own[0].shown));
          this.draw();
        };
        this.bar.append(button);
      }
    }

    drag(e) {
      if (!this.canvas.hasPointerCapture(e.pointerId)) return;
      if (e.shiftKey) {
        this.shift[0] += e.movementX;
        this.shift[1] += e.movementY;
      } else {
        this.turn += 0.008 * e.movementX;
        this.lift = Math.min(1.55, Math.max(-1.55, this.lift + 0.008 * e.movementY));
      }
      this.draw();
    }

    label() { this.play.textContent = this.playing ? "Pause" : "Play"; }
    stop() { this.playing = false; this.label(); }
    start() {
      this.playing = true;
      this.label();
      const last = this.time.length - 1;
      const begun = performance.now() / 1000 - (this.frame === last ? 0 : this.time[this.frame] - this.time[0]);
      const span = this.time[last] - this.time[0] || 1;
      const step = () => {
        if (!this.playing) return;
        const now = this.time[0] + ((performance.now() / 1000 - begun) % (span + 0.5));
        let k = 0;
        while (k < last && this.time[k + 1] <= now) k++;
        if (k !== this.frame) { this.frame = k; this.draw(); }
        requestAnimationFrame(step);
      };
      requestAnimationFrame(step);
    }

    // camera coordinates of a part's nodes in the frame that is shown: right, up, towards the eye
    placed(part) {
      const all = part.at, size = 3 * (part.nodes ?? all.length / 3);
      const from = part.kind === "deforming" ? this.frame * size : 0;
      const out = new Float32Array(size), p = part.poses, k = 12 * this.frame;
      const [ct, st, cl, sl] = [Math.cos(this.turn), Math.sin(this.turn), Math.cos(this.lift), Math.sin(this.lift)];
      for (let i = 0; i < size; i += 3) {
        let x = all[from + i], y = all[from + i + 1], z = all[from + i + 2];
        if (p) {
          [x, y, z] = [
            p[k] * x + p[k + 1] * y + p[k + 2] * z + p[k + 9],
            p[k + 3] * x + p[k + 4] * y + p[k + 5] * z + p[k + 10],
            p[k + 6] * x + p[k + 7] * y + p[k + 8] * z + p[k + 11]];
        }
        x -= this.middle[0]; y -= this.middle[1]; z -= this.middle[2];
        const a = ct * x - st * y, b = st * x + ct * y;
        out[i] = a; out[i + 1] = cl * z + sl * b; out[i + 2] = sl * z - cl * b;
      }
      return out;
    }

    draw() {
      const wide = this.canvas.clientWidth || 600, high = this.canvas.clientHeight || 360;
      const dense = window.devicePixelRatio || 1;
      if (this.canvas.width !== Math.round(wide * dense)) {
        this.canvas.width = Math.round(wide * dense);
        this.canvas.height = Math.round(high * dense);
      }
      const pen = this.canvas.getContext("2d");
      pen.setTransform(dense, 0, 0, dense, 0, 0);
      pen.clearRect(0, 0, wide, high);
      const unit = 0.46 * this.zoom * Math.min(wide / this.aside, high / this.above), eye = 4 * this.reach;
      const spot = (c, i) => {
        const near = eye / (eye - c[i + 2]);
        return [wide / 2 + this.shift[0] + unit * near * c[i], high / 2 + this.shift[1] - unit * near * c[i + 1]];
      };
      this.ground(pen, spot);
      const faces = [];
      for (const part of this.parts) {
        if (!part.shown) continue;
        const c = this.placed(part);
        if (part.kind === "line") { this.line(pen, part, c, spot); continue; }
        const t = part.triangles;
        for (let f = 0; f < t.length; f += 3) {
          const i = 3 * t[f], j = 3 * t[f + 1], k = 3 * t[f + 2];
          const u = [c[j] - c[i], c[j + 1] - c[i + 1], c[j + 2] - c[i + 2]];
          const v = [c[k] - c[i], c[k + 1] - c[i + 1], c[k + 2] - c[i + 2]];
          const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
          const towards = n[2] * (eye - c[i + 2]) - n[0] * c[i] - n[1] * c[i + 1];
          if (part.closed && towards < 0) continue; // hidden by the part itself
          const length = Math.hypot(...n) || 1;
          const light = Math.abs(0.35 * n[0] + 0.6 * n[1] + 0.72 * n[2]) / length;
          faces.push({ depth: c[i + 2] + c[j + 2] + c[k + 2], part, c, i, j, k,
            tone: Math.min(32, Math.round(32 * light)) });
        }
      }
      faces.sort((a, b) => a.depth - b.depth);
      pen.lineWidth = 0.6;
      for (const face of faces) {
        pen.fillStyle = pen.strokeStyle = face.part.shades[face.tone];
        pen.beginPath();
        pen.moveTo(...spot(face.c, face.i));
        pen.lineTo(...spot(face.c, face.j));
        pen.lineTo(...spot(face.c, face.k));
        pen.closePath();
        pen.globalAlpha = face.part.opacity ?? 1;
        pen.fill();
        if (pen.globalAlpha === 1) pen.stroke(); // closes the hairline between neighbors
      }
      pen.globalAlpha = 1;
      this.slider.value = this.frame;
      this.clock.textContent = `${this.time[this.frame].toFixed(2)} s`;
      this.box.dataset.drawn = faces.length; // for tests
      this.box.dataset.frame = this.frame;
    }

    line(pen, part, c, spot) {
      pen.strokeStyle = part.color;
      pen.lineWidth = 1.4;
      pen.beginPath();
      for (let i = 0; i < c.length; i += 3) pen[i ? "lineTo" : "moveTo"](...spot(c, i));
      pen.stroke();
    }

    ground(pen, spot) {
      const cell = 10 ** Math.floor(Math.log10(this.reach)), count = Math.ceil((1.2 * this.reach) / cell);
      const flat = { kind: "line", at: [] };
      for (let k = -count; k <= count; k++) {
        for (const [x, y] of [[k, -count], [k, count], [-count, k], [count, k]]) {
          flat.at.push(this.middle[0] + x * cell, this.middle[1] + y * cell, this.floor);
        }
      }
      const c = this.placed(flat);
      pen.strokeStyle = "#d9dde4";
      pen.lineWidth = 1;
      pen.beginPath();
      for (let i = 0; i < c.length; i += 6) {
        pen.moveTo(...spot(c, i));
        pen.lineTo(...spot(c, i + 3));
      }
      pen.stroke();
    }
  }

  for (const box of document.querySelectorAll(".moving")) new View(box);
})();
