"use strict";
// Sorting and filtering of the leaderboard. `Board` works on plain data and is tested without a
// browser; the rest reads the table of the page, and moves and hides its rows.

var Board = {
  // Compare two cells: numbers by value, words by letter; what was not measured comes last.
  compare: function (a, b, descending) {
    if (a === null || b === null) {
      return (a === null ? 1 : 0) - (b === null ? 1 : 0);
    }
    var order = typeof a === "number" ? a - b : a < b ? -1 : a > b ? 1 : 0;
    return descending ? -order : order;
  },

  // Return the numbers of the rows, in the order that a column asks for; equal rows keep theirs.
  // Rows that lack a part of their suite (1 in `lacks`, else 0) come after the others.
  order: function (cells, descending, lacks) {
    return cells
      .map(function (cell, index) { return [cell, index]; })
      .sort(function (a, b) {
        return (lacks ? lacks[a[1]] - lacks[b[1]] : 0) ||
          Board.compare(a[0], b[0], descending) || a[1] - b[1];
      })
      .map(function (pair) { return pair[1]; });
  },

  // Whether a row is shown: each filter is empty, or what the row has or one of several.
  shown: function (row, filters) {
    return Object.keys(filters).every(function (key) {
      return filters[key] === "" || [].concat(row[key]).indexOf(filters[key]) >= 0;
    });
  },

  // The name of the scores that perturbation and severity ask for together.
  scope: function (state) {
    return state.severity === "" ? state.scope : state.scope + "@" + state.severity;
  },

  // The state of the page as the part of its address behind "#", and back.
  write: function (state) {
    return Object.keys(state)
      .filter(function (key) { return state[key] !== ""; })
      .map(function (key) { return key + "=" + encodeURIComponent(state[key]); })
      .join("&");
  },
  read: function (text) {
    var state = {};
    text.replace(/^#/, "").split("&").forEach(function (part) {
      var at = part.indexOf("=");
      if (at > 0) {
        try {
          state[part.slice(0, at)] = decodeURIComponent(part.slice(at + 1));
        } catch (error) {
          // An address that somebody cut short says nothing.
        }
      }
    });
    return state;
  },
};

if (typeof document !== "undefined") {
  (function () {
    var sections = document.querySelectorAll("section.suite");
    if (!sections.length) { return; }
    var groups = Array.prototype.map.call(sections, function (section) {
      var body = section.querySelector("tbody");
      return { section: section, body: body, rows: Array.prototype.slice.call(body.rows) };
    });
    var rows = groups.reduce(function (all, group) { return all.concat(group.rows); }, []);
    var buttons = Array.prototype.slice.call(document.querySelectorAll("#measured th button"));
    var selects = {
      suite: document.getElementById("suite"),
      scope: document.getElementById("scope"),
      severity: document.getElementById("severity"),
      budget: document.getElementById("budget"),
      training: document.getElementById("training"),
    };
    var status = document.getElementById("status");
    var state = {
      suite: "", scope: "macro", severity: "", budget: "", training: "", sort: "psnr", down: "1",
    };

    function facts(row) {
      var training = row.dataset.training.split(" ");
      return { suite: row.dataset.suite, budget: row.dataset.budget, training: training };
    }

    function value(row, key) {
      var cell = row.querySelector('[data-key="' + key + '"]');
      if (!cell) { return null; }
      if (cell.dataset.scores) {
        var score = JSON.parse(cell.dataset.scores)[Board.scope(state)];
        return score === undefined ? null : score;
      }
      if (cell.dataset.number !== undefined) {
        return cell.dataset.number === "" ? null : Number(cell.dataset.number);
      }
      return cell.textContent.trim().toLowerCase();
    }

    function show() {
      rows.forEach(function (row) {
        Array.prototype.forEach.call(row.querySelectorAll("[data-scores]"), function (cell) {
          var score = value(row, cell.dataset.key);
          cell.textContent = score === null ? "–" : score.toFixed(Number(cell.dataset.digits));
        });
        var chosen = { suite: state.suite, budget: state.budget, training: state.training };
        row.hidden = !Board.shown(facts(row), chosen);
      });
      // Rows are compared within their suite alone.
      groups.forEach(function (group) {
        var cells = group.rows.map(function (row) { return value(row, state.sort); });
        var lacks = group.rows.map(function (row) { return Number(row.dataset.lacks); });
        Board.order(cells, state.down === "1", lacks).forEach(function (index) {
          group.body.appendChild(group.rows[index]);
        });
        group.section.hidden = group.rows.every(function (row) { return row.hidden; });
      });
      buttons.forEach(function (button) {
        var on = button.dataset.sort === state.sort;
        var way = state.down === "1" ? "descending" : "ascending";
        button.parentNode.setAttribute("aria-sort", on ? way : "none");
      });
      Object.keys(selects).forEach(function (key) { selects[key].value = state[key]; });
      var count = rows.filter(function (row) { return !row.hidden; }).length;
      status.textContent = count + " of " + rows.length + " rows";
    }

    function change() {
      history.replaceState(null, "", "#" + Board.write(state));
      show();
    }

    function load() {
      var asked = Board.read(location.hash);
      Object.keys(selects).forEach(function (key) {
        var options = Array.prototype.map.call(selects[key].options, function (o) { return o.value; });
        if (options.indexOf(asked[key]) >= 0) { state[key] = asked[key]; }
      });
      if (buttons.some(function (button) { return button.dataset.sort === asked.sort; })) {
        state.sort = asked.sort;
        state.down = asked.down === "1" ? "1" : "";
      }
      show();
    }

    buttons.forEach(function (button) {
      button.addEventListener("click", function () {
        var again = state.sort === button.dataset.sort;
        state.sort = button.dataset.sort;
        state.down = again ? (state.down === "1" ? "" : "1") : button.dataset.down;
        change();
      });
    });
    Object.keys(selects).forEach(function (key) {
      selects[key].addEventListener("change", function () {
        state[key] = selects[key].value;
        change();
      });
    });
    window.addEventListener("hashchange", load);
    document.getElementById("controls").hidden = false;
    load();
  })();
}
