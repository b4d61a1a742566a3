// Charts wait as text until plotly is there: it comes along gzipped, a third of its size. Menus
// of plotly become those of the page: long names fit, and keys choose.
(async () => {
  const show = (text) => {
    for (const figure of document.querySelectorAll(".chart")) figure.append(text);
  };
  if (typeof DecompressionStream === "undefined") {
    show("This browser is too old for the charts (it needs DecompressionStream).");
    return;
  }
  const packed = Uint8Array.from(
    atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const run = (text, place) => {
    const script = document.createElement("script");
    script.textContent = text;
    place(script);
  };
  run(await new Response(stream).text(), (script) => document.head.append(script));

  // a phone has no place for panels side by side: they come below each other, row by row
  const axes = (layout, letter) => Object.keys(layout).filter((k) => k.startsWith(`${letter}axis`));
  const stacked = (layout, width) => {
    const [xs, ys] = ["x", "y"].map((letter) => axes(layout, letter));
    const start = (name) => (layout[name].domain ?? [0, 1])[0];
    const across = [...new Set(xs.map(start))].sort((a, b) => a - b);
    if (width >= 600) return layout;
    const margin = { ...layout.margin, l: 56, r: 8 }, legend = { ...layout.legend };
    if (across.length < 2) return { ...layout, margin };
    const place = (y) => across.indexOf(start((layout[y].anchor ?? "x").replace("x", "xaxis")));
    const panels = [...ys].sort((a, b) => start(b) - start(a) || place(a) - place(b));
    const out = { ...layout, margin, height: layout.height * across.length };
    const inside = (height) => height - margin.t - margin.b, gap = 84 / inside(out.height);
    const tall = (1 - gap * (panels.length - 1)) / panels.length, titles = out.annotations ?? [];
    const moved = [];
    panels.forEach((y, k) => {
      const top = 1 - k * (tall + gap), x = (layout[y].anchor ?? "x").replace("x", "xaxis");
      out[y] = { ...layout[y], domain: [Math.max(top - tall, 0), top] };
      out[x] = { ...layout[x], domain: [0, 1], showticklabels: true };
      if (titles[k]) moved.push({ ...titles[k], x: 0.5, y: top });
    });
    legend.y = 1 + ((legend.y ?? 1) - 1) * inside(layout.height) / inside(out.height);
    return { ...out, legend, annotations: [...moved, ...titles.slice(panels.length)] };
  };
  // of many runs only the one that is chosen is drawn; what the legend hid stays hidden
  const chosen = (data, { args }) => data.filter((_, i) => args[0].visible[i])
    .map((line) => ({ ...line, visible: true }));
  const menu = (plot, data, layout, { name, buttons }) => {
    const label = document.createElement("label"), select = document.createElement("select");
    for (const { label: text } of buttons) select.append(new Option(text));
    select.onchange = () => {
      const off = new Set(plot.data.filter((d) => d.visible === "legendonly").map((d) => d.name));
      const lines = chosen(data, buttons[select.selectedIndex])
        .map((line) => (off.has(line.name) ? { ...line, visible: "legendonly" } : line));
      window.Plotly.react(plot, lines, structuredClone(layout)); // its own range, no zoom of another
    };
    label.append(`${name}: `, select);
    plot.closest(".chart").prepend(label);
  };
  const plotly = window.Plotly, draw = plotly.newPlot;
  let drawn;
  plotly.newPlot = (place, data, { updatemenus: [given] = [], ...wide }, config) => {
    const plot = document.getElementById(place);
    const layout = stacked(wide, plot.closest(".chart").clientWidth);
    plot.style.height = plot.parentElement.style.height = `${layout.height}px`;
    if (given) menu(plot, data, layout, given);
    const first = given ? chosen(data, given.buttons[0]) : data;
    drawn = draw(plot, first, structuredClone(layout), config);
    return drawn;
  };
  for (const waiting of document.querySelectorAll('script[type="text/x-chart"]')) {
    run(waiting.textContent, (script) => waiting.replaceWith(script));
    await drawn;
    await new Promise((next) => setTimeout(next)); // the page stays at hand meanwhile
  }
})();
