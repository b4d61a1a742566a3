// Charts wait as text until plotly is there: it comes along gzipped, a third of its size.
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
  for (const waiting of document.querySelectorAll('script[type="text/x-chart"]')) {
    run(waiting.textContent, (script) => waiting.replaceWith(script));
  }
})();
