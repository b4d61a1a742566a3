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
  plotly.newPlot = (place, data, { updatemenus: [given] = [], ...layout }, config) => {
    const plot = document.getElementById(place);
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
