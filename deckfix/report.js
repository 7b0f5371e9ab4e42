"use strict";
(function () {
  const narrow = () => window.innerWidth < 760;
  function draw(place) {
    const figure = JSON.parse(document.getElementById("data-" + place.id).textContent);
    if (narrow()) {
      figure.layout.dragmode = false;
      figure.layout.margin.l = 50;
      figure.layout.margin.r = 6;
    }
    const settings = { responsive: true, displaylogo: false, displayModeBar: false, doubleClick: "reset" };
    return Plotly.newPlot(place, figure.data, figure.layout, settings);
  }
  const places = Array.from(document.querySelectorAll(".plot"));
  function next() {
    const place = places.shift();
    if (!place) { document.body.dataset.drawn = "yes"; return; }
    draw(place).then(() => setTimeout(next, 0));
  }
  next();
})();
