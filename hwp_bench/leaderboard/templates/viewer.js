"use strict";
// The viewer of the leaderboard: two pictures of one frame, one over the other, with a divider that
// moves. The divider is a range input, so that mouse, touch and keyboard all move it.
// `GALLERY` is the list of frames that gallery.js holds.

if (typeof document !== "undefined" && document.getElementById("viewer")) {
  (function () {
    var scenes = GALLERY;
    var at = function (name) { return document.getElementById("viewer-" + name); };
    var captures = scenes
      .map(function (scene) { return scene.capture; })
      .filter(function (name, index, all) { return all.indexOf(name) === index; });

    function fill(select, values, texts) {
      var before = select.value;
      select.textContent = "";
      values.forEach(function (value, index) {
        var option = document.createElement("option");
        option.value = value;
        option.textContent = texts[index];
        select.appendChild(option);
      });
      if (values.indexOf(before) >= 0) { select.value = before; }
    }

    function scene() {
      return scenes.filter(function (one) {
        return one.capture === at("capture").value && String(one.frame) === at("frame").value;
      })[0];
    }

    // The picture of a choice: "truth", or the name of an entry.
    function shot(one, choice) {
      if (choice === "truth") { return { picture: one.truth, error: "", title: "Truth", psnr: null }; }
      return one.shots.filter(function (item) { return item.entry === choice; })[0] || null;
    }

    function caption(item) {
      return item.psnr === null ? item.title : item.title + ", " + item.psnr.toFixed(2) + " dB";
    }

    function chooseCapture() {
      var frames = scenes.filter(function (one) { return one.capture === at("capture").value; });
      fill(at("frame"), frames.map(function (one) { return String(one.frame); }),
        frames.map(function (one) { return "frame " + one.frame; }));
      chooseFrame();
    }

    function chooseFrame() {
      var one = scene();
      var names = one.shots.map(function (item) { return item.entry; });
      var titles = one.shots.map(function (item) { return item.title; });
      // At first the best method of the suite is on the right and the next one on the left.
      var usual = { right: names[0], left: names.length > 1 ? names[1] : "truth" };
      ["left", "right"].forEach(function (side) {
        var select = at(side);
        var chosen = select.selectedOptions.length ? select.selectedOptions[0].textContent : "";
        fill(select, ["truth"].concat(names), ["Truth"].concat(titles));
        // Another suite has other entries: the one of the same title stays.
        var same = ["Truth"].concat(titles).indexOf(chosen);
        select.value = same < 0 ? usual[side] : select.options[same].value;
      });
      draw();
    }

    function draw() {
      var one = scene();
      ["left", "right"].forEach(function (side) {
        var item = shot(one, at(side).value);
        at(side + "-picture").src = item.picture;
        at(side + "-picture").alt = caption(item) + ", " + one.capture + ", frame " + one.frame;
        at(side + "-caption").textContent = caption(item);
        at(side + "-error-figure").hidden = item.error === "";
        if (item.error !== "") {
          at(side + "-error").src = item.error;
          at(side + "-error").alt = "Error of " + caption(item);
          at(side + "-error-caption").textContent = "Error of " + item.title;
        }
      });
      at("truth").src = one.truth;
      at("truth").alt = "Truth of " + one.capture + ", frame " + one.frame;
    }

    function move() {
      var share = Number(at("divider").value);
      at("left-picture").style.clipPath = "inset(0 " + (100 - share) + "% 0 0)";
      at("line").style.left = share + "%";
    }

    fill(at("capture"), captures, captures);
    at("capture").addEventListener("change", chooseCapture);
    at("frame").addEventListener("change", chooseFrame);
    at("left").addEventListener("change", draw);
    at("right").addEventListener("change", draw);
    at("divider").addEventListener("input", move);
    document.getElementById("viewer").hidden = false;
    chooseCapture();
    move();
  })();
}
