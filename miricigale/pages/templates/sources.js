"use strict";
// The table, its filters and what is shown of one source. Details and pictures are in files of `facts.chunk`
// sources each, which are loaded as scripts and images, since a page of the file system can read no other data.
(function () {
  const facts = JSON.parse(document.getElementById("facts").textContent);
  const table = facts.table, bands = facts.bands;
  // of a study with truths and fits, or of measured images alone
  const study = "selection" in table;
  if (!study) Object.assign(facts, { truths: [], sets: [], compared: [] });
  const sets = facts.sets;
  const miri = bands.filter((band) => band.miri);
  const setOf = Object.fromEntries(sets.map((set) => [set.name, set]));
  const DASHES = { none: "5 3", blue: "1.5 2", red: "8 2 1.5 2" };
  const ROW = 24;
  const KEPT = 40;
  const $ = (id) => document.getElementById(id);

  // ------------------------------------------------------------------ small helpers

  function make(tag, attributes, ...children) {
    return fill(document.createElement(tag), attributes, children);
  }

  function draw(tag, attributes, ...children) {
    return fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
  }

  function fill(node, attributes, children) {
    for (const [name, value] of Object.entries(attributes || {})) {
      if (value === null || value === undefined || value === false) continue;
      if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
      else node.setAttribute(name, value);
    }
    node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
    return node;
  }

  function number(value, digits) {
    if (value === null || value === undefined) return "–";
    if (digits !== undefined) return value.toFixed(digits).replace("-", "−");
    const size = Math.abs(value);
    if (size !== 0 && (size >= 1e5 || size < 1e-3)) return value.toExponential(2).replace("e+", "e").replaceAll("-", "−");
    return String(Number(value.toPrecision(4))).replace("-", "−");
  }

  function bits(kind, value) {
    const found = [];
    for (const bit of Object.keys(facts.flags[kind] || {})) {
      if (value & Number(bit)) found.push(facts.flags[kind][bit]);
    }
    return found;
  }

  const words = (kind, value) => bits(kind, value).map((pair) => pair[0]);

  // ------------------------------------------------------------------ rows and columns

  const names = Object.keys(table);
  const rows = table.id.map((_, i) => {
    const row = { i };
    for (const name of names) row[name] = table[name][i];
    row.outlier = {};
    for (const set of facts.compared) {
      const z = row["redshift_" + set];
      row.outlier[set] = z !== null && z !== undefined && row.redshift !== null
        && Math.abs(z - row.redshift) / (1 + row.redshift) > facts.outlier;
    }
    const noted = new Set([...words("selection", row.selection), ...words("condition", row.condition)]);
    for (const set of facts.compared) words("fit", row["fit_" + set]).forEach((word) => noted.add(word));
    for (const band of bands) words("photometry", row["flags_" + band.name]).forEach((word) => noted.add(word));
    row.words = [...noted];
    row.flags = row.words.join(", ");
    return row;
  });
  const byId = new Map(rows.map((row) => [String(row.id), row]));

  const columns = [{ key: "id", group: "", label: "id", title: "id of the catalog", plain: true }];
  if (study) columns.push({ key: "mag", group: "", label: facts.prior, title: "true AB magnitude in the band of the prior", digits: 2 });
  for (const band of bands) {
    if (!("mag_" + band.name in table)) continue;
    columns.push({ key: "mag_" + band.name, group: "AB", label: band.label, title: "magnitude, or its limit (" + facts.limits + ")", digits: 2, limit: "limit_" + band.name });
    columns.push({ key: "chi2_" + band.name, group: "χ²", label: band.label, title: "template-weighted mean of (residual / sigma)²", digits: 2 });
  }
  columns.sort((a, b) => (a.group > b.group) - (a.group < b.group));
  for (const [key, group, digits, value] of [["redshift", "redshift", 3, "mean"], ["frac_agn", "fracAGN", 2, "median"]]) {
    if (study) columns.push({ key, group, label: "true", title: "injected", digits });
    for (const set of facts.compared) {
      if (!(key + "_" + set in table)) continue;
      columns.push({ key: key + "_" + set, group, label: setOf[set].label, title: "posterior " + value + ", " + setOf[set].label, digits, set });
    }
  }
  for (const band of miri) {
    columns.push({ key: "sn_" + band.name, group: "S/N", label: band.label, title: "measured flux over " + (study ? "the error of the error function" : "its error"), digits: 1 });
  }
  if (study) columns.push({ key: "n_detected", group: " ", label: "bands", title: "MIRI bands above 5 sigma" });
  for (const set of facts.compared) {
    columns.push({ key: "chi2_" + set, group: "reduced χ²", label: setOf[set].label, title: "of the best model", digits: 2 });
  }
  columns.push({ key: "flags", group: "flags", label: "in words", title: study ? "why it is not fitted, conditions, flags of the fits" : "flags of all bands", text: true });
  columns.forEach((column, k) => { column.first = k > 0 && columns[k - 1].group !== column.group; });

  // ------------------------------------------------------------------ state, kept in the address

  const outside = 1; // bit of the selection: outside of the pixels that all bands share
  const shows = study ? { field: ["in the field", (row) => !(row.selection & outside)] } : {};
  shows.all = ["all of the catalog", () => true];
  if (study) {
    shows.sample = ["the sample (fitted)", (row) => row.selection === 0];
    shows.left = ["in the field, not fitted", (row) => row.selection !== 0 && !(row.selection & outside)];
  } else {
    shows.detected = ["with a magnitude in any band", (row) => bands.some((band) => row["limit_" + band.name] === false)];
  }
  for (const set of facts.compared) {
    shows["outliers_" + set] = ["outliers in z " + setOf[set].label, (row) => row.outlier[set]];
  }
  if (study) shows.outliers = ["outliers in z of either", (row) => facts.compared.some((set) => row.outlier[set])];
  const first = Object.keys(shows)[0];
  const blank = () => ({ id: null, sort: "id", down: false, show: first, flag: "", text: "", ranges: {} });
  let state = blank();
  let listed = [];

  function readAddress() {
    const [id, query] = location.hash.slice(1).split("?");
    state = blank();
    state.id = id ? decodeURIComponent(id) : null;
    for (const [name, value] of new URLSearchParams(query || "")) {
      if (name === "sort") { state.sort = value.replace(/^-/, ""); state.down = value.startsWith("-"); }
      else if (name === "show" && value in shows) state.show = value;
      else if (name === "flag" || name === "text") state[name] = value;
      else if (columns.some((column) => column.key === name)) state.ranges[name] = value;
    }
    if (!columns.some((column) => column.key === state.sort)) state.sort = "id";
  }

  function address() {
    const query = new URLSearchParams();
    if (state.sort !== "id" || state.down) query.set("sort", (state.down ? "-" : "") + state.sort);
    if (state.show !== first) query.set("show", state.show);
    for (const name of ["flag", "text"]) if (state[name]) query.set(name, state[name]);
    for (const [name, value] of Object.entries(state.ranges)) if (value) query.set(name, value);
    const text = query.toString();
    return "#" + (state.id === null ? "" : encodeURIComponent(state.id)) + (text ? "?" + text : "");
  }

  function writeAddress() {
    const text = address(), row = byId.get(state.id);
    $("hidden").textContent = row && !listed.includes(row) ? "Source " + state.id + ", shown below, is not in the list: the filters leave it out." : "";
    if (text !== location.hash) history.replaceState(null, "", text);
    for (const link of $("truths").querySelectorAll("a")) link.hash = text;
  }

  // ------------------------------------------------------------------ filters and order

  // what a range such as 0.5..2, >5, <=1 or a value asks for; null where it cannot be read
  function range(text) {
    const plain = text.replaceAll("−", "-").replaceAll(" ", "");
    const span = plain.match(/^([^.<>=]*(?:\.[^.]+)?)?\.\.(.*)$/);
    if (span) {
      const low = span[1] ? Number(span[1]) : -Infinity, high = span[2] ? Number(span[2]) : Infinity;
      return isNaN(low) || isNaN(high) ? null : (value) => value >= low && value <= high;
    }
    const side = plain.match(/^(<=|>=|<|>|=)?(.+)$/);
    if (!side || isNaN(Number(side[2]))) return null;
    const limit = Number(side[2]);
    return {
      "<": (value) => value < limit, ">": (value) => value > limit,
      "<=": (value) => value <= limit, ">=": (value) => value >= limit,
    }[side[1]] || ((value) => value === limit);
  }

  function testOf(column, text) {
    if (column.text || typeof table[column.key][0] === "string") {
      const parts = text.toLowerCase().split(/\s+/).filter(Boolean);
      return (row) => parts.every((part) => String(row[column.key]).toLowerCase().includes(part));
    }
    const wanted = range(text);
    return wanted && ((row) => row[column.key] !== null && wanted(row[column.key]));
  }

  function apply() {
    const tests = [shows[state.show][1]];
    if (state.flag) tests.push((row) => row.words.includes(state.flag));
    const parts = state.text.toLowerCase().split(/\s+/).filter(Boolean);
    if (parts.length) tests.push((row) => parts.every((part) => String(row.id) === part || row.flags.includes(part)));
    for (const column of columns) {
      const text = (state.ranges[column.key] || "").trim(), test = text && testOf(column, text);
      const input = $("range-" + column.key);
      input.setAttribute("aria-invalid", String(Boolean(text) && !test));
      input.style.background = text && !test ? "#fee2e2" : "";
      if (test) tests.push(test);
    }
    listed = rows.filter((row) => tests.every((test) => test(row)));
    const key = state.sort, sign = state.down ? -1 : 1;
    const missing = (value) => value === null || value === undefined || value === "";
    listed.sort((a, b) => {
      const x = a[key], y = b[key];
      // what has no value comes last in either direction
      if (missing(x) || missing(y)) return missing(x) - missing(y) || a.i - b.i;
      return sign * (typeof x === "string" ? x.localeCompare(y) : x - y) || a.i - b.i;
    });
    $("count").textContent = listed.length + " of " + rows.length + " sources";
    for (const button of $("list").querySelectorAll("thead button")) {
      const own = button.dataset.key === key;
      button.querySelector("span").textContent = own ? (state.down ? " ↓" : " ↑") : "";
      button.closest("th").setAttribute("aria-sort", own ? (state.down ? "descending" : "ascending") : "none");
    }
    writeAddress();
    render();
  }

  // ------------------------------------------------------------------ the table: only rows in sight are made

  function buildTable() {
    const groups = [];
    for (const column of columns) {
      const last = groups[groups.length - 1];
      if (last && last.name === column.group) last.n += 1;
      else groups.push({ name: column.group, n: 1, first: column.first });
    }
    const head = $("list").tHead;
    head.append(
      make("tr", { class: "group" }, groups.map((g) => make("th", { colspan: g.n, class: g.first ? "first" : null }, g.name))),
      make("tr", {}, columns.map((column) => make("th", { class: cellClass(column), title: column.title },
        make("button", { type: "button", "data-key": column.key, onclick: () => sortBy(column.key) }, column.label, make("span", {}))))),
      make("tr", {}, columns.map((column) => make("th", { class: cellClass(column) },
        make("input", { id: "range-" + column.key, "aria-label": "filter of " + column.group + " " + column.label,
          oninput: (event) => { state.ranges[column.key] = event.target.value; apply(); } })))));
  }

  const cellClass = (column) => [column.text ? "t" : "", column.first ? "first" : ""].join(" ").trim() || null;

  function sortBy(key) {
    state.down = state.sort === key ? !state.down : false;
    state.sort = key;
    apply();
  }

  function cell(row, column) {
    const value = row[column.key];
    const off = column.key.startsWith("redshift_") && row.outlier[column.set];
    const shown = (row[column.limit] ? "> " : "") + (column.plain ? String(value) : typeof value === "string" ? value : number(value, column.digits));
    return make("td", { class: [cellClass(column), off ? "outlier" : ""].join(" ").trim() || null, title: column.text && value ? value : null }, shown);
  }

  function render() {
    const box = $("scroll"), body = $("list").tBodies[0];
    const first = Math.max(0, Math.floor(box.scrollTop / ROW) - 8);
    const last = Math.min(listed.length, first + Math.ceil(box.clientHeight / ROW) + 16);
    const spacer = (n) => n > 0 ? make("tr", { "aria-hidden": "true", style: "height:" + n * ROW + "px" }, make("td", { colspan: columns.length, style: "border:0;height:auto" })) : null;
    body.replaceChildren(...[
      spacer(first),
      ...listed.slice(first, last).map((row) => make("tr", {
        class: String(row.id) === state.id ? "chosen" : null, "data-id": row.id,
        onclick: () => choose(row, false),
      }, columns.map((column) => cell(row, column)))),
      spacer(listed.length - last),
    ].filter(Boolean));
  }

  function choose(row, intoView) {
    state.id = String(row.id);
    const at = listed.indexOf(row), box = $("scroll");
    if (intoView && at >= 0) {
      const height = box.clientHeight - $("list").tHead.offsetHeight;
      if (at * ROW < box.scrollTop) box.scrollTop = at * ROW;
      else if ((at + 1) * ROW > box.scrollTop + height) box.scrollTop = (at + 1) * ROW - height;
    }
    writeAddress();
    render();
    show(row);
  }

  function move(step) {
    if (!listed.length) return;
    const now = listed.findIndex((row) => String(row.id) === state.id);
    const next = now < 0 ? 0 : Math.min(listed.length - 1, Math.max(0, now + step));
    choose(listed[next], true);
  }

  // ------------------------------------------------------------------ details, loaded by file

  const files = new Map();
  const stem = (k) => facts.folder + "/" + String(k).padStart(3, "0");

  window.loaded = (k, entries) => {
    const file = files.get(k);
    if (!file) return;
    file.entries = entries;
    file.then.forEach((go) => go());
  };

  function withFile(k, go) {
    let file = files.get(k);
    if (!file) {
      file = { entries: null, then: [], image: new Image() };
      // pictures of a large field would fill the memory: those that were looked at long ago are loaded again
      if (files.size >= KEPT) files.delete(files.keys().next().value);
      files.set(k, file);
      file.image.src = stem(k) + ".png";
      document.head.append(make("script", { src: stem(k) + ".js", onerror: () => missing(k) }));
    }
    if (file.entries) go(file);
    else file.then.push(() => go(file));
  }

  function missing(k) {
    files.delete(k);
    $("detail").replaceChildren(make("p", { class: "why" }, "The file " + stem(k) + ".js, which belongs to this page, is not there."));
  }

  function show(row) {
    withFile(Math.floor(row.i / facts.chunk), (file) => {
      if (String(row.id) !== state.id) return;
      const entry = file.entries[row.i % facts.chunk];
      if (!study) Object.assign(entry, { true: bands.map(() => null), conditions: bands.map(() => 0) });
      $("detail").replaceChildren(
        heading(row, entry),
        make("section", { class: "wide" }, make("h3", {}, "Images"), cutouts(row, entry, file.image)),
        make("section", {}, make("h3", {}, "Photometry" + (study ? " and best models" : "")), spectrum(entry)),
        make("section", {}, study ? [make("h3", {}, "Posteriors"), posteriors(row, entry)] : null, make("h3", {}, "Flags"), flags(row, entry)),
        make("section", {}, make("h3", {}, "Fluxes (µJy)"), fluxes(entry)),
        study ? make("section", {}, make("h3", {}, "Parameters"), parameters(entry)) : "");
    });
  }

  function heading(row, entry) {
    const item = (label, value) => make("span", {}, label + " ", make("b", {}, value));
    const items = [item("RA", number(row.ra, 6)), item("Dec", number(row.dec, 6))];
    if (study) items.push(item(facts.prior, number(row.mag, 2)), item("true z", number(row.redshift, 4)), item("true fracAGN", number(row.frac_agn, 3)));
    for (const set of sets) {
      const fit = entry.fits && entry.fits[set.name];
      if (!fit) continue;
      items.push(item("χ² " + set.label, number(fit.chi2, 1) + " in " + fit.n_bands + " bands"));
    }
    const why = bits("selection", row.selection).map(([word, text]) => make("li", {}, make("b", {}, word), ": " + text));
    return make("section", { class: "wide" }, make("h2", {}, "Source " + row.id), make("div", { class: "facts" }, items),
      why.length ? make("div", { class: "why" }, "Not fitted:", make("ul", {}, why)) : null);
  }

  // ------------------------------------------------------------------ pictures

  function cutouts(row, entry, image) {
    const c = facts.cutouts;
    if (!entry.top) {
      return make("p", {}, !entry.imaged ? "No band has data at this position."
        : "Without pictures: " + facts.pictured + " sources have some, " + (study ? "those that were fitted first, then the brightest ([report] pictures)." : "those of the highest signal-to-noise."));
    }
    const y0 = (row.i % facts.chunk) * c.height;
    const ring = 100 * 2 / c.box;
    function cut(x, y, n) {
      const canvas = make("canvas", { width: n, height: n });
      const paint = () => { canvas.getContext("2d").drawImage(image, x, y0 + y, n, n, 0, 0, n, n); };
      if (image.complete && image.naturalWidth) paint();
      else image.addEventListener("load", paint, { once: true });
      return make("span", { class: "cut", style: "--ring:" + ring + "%;--off:" + (50 - ring / 2) + "%" }, canvas);
    }
    const limits = (k) => number(c.lowest * c.sigma[k]) + " to " + number(entry.top[k]);
    const prior = cut(0, 0, c.prior);
    prior.append(...neighbors(row, c.box));
    const size = Math.max(60, Math.min(150, Math.floor(($("detail").clientWidth - 70) / (miri.length + 2))));
    const grid = make("div", { class: "bands", style: "grid-template-columns: 1.1rem repeat(" + miri.length + ", " + size + "px)" },
      make("span", {}), miri.map((band) => make("b", {}, band.label)),
      ["mosaic", "model", "residual"].map((label, r) => [
        make("span", { class: "side" }, label),
        miri.map((_, k) => cut(c.prior + k * c.side, r * c.side, c.side)),
      ]),
      make("span", {}), miri.map((_, k) => make("span", {}, limits(k + 1))));
    return make("div", {},
      make("div", { class: "cutouts" },
        make("div", { style: "width:" + 2 * size + "px;font-size:11px;text-align:center;color:var(--soft)" },
          make("b", {}, facts.prior + " (prior)"), prior, limits(0)),
        grid),
      make("p", { class: "note" }, c.box + " arcsec on a side, " + (study ? "north up, east left" : "along the pixels of each image") + "; circle: 1 arcsec about the " + (study ? "true " : "") + "position; "
        + "blue: other sources of the catalog; sand: no data. Mosaic, model and residual of a band have one stretch: asinh of the value over "
        + c.softening + " times the noise of a pixel (in residuals), between the limits beneath in " + c.unit + ", which are " + number(c.lowest)
        + " times the noise and the brightest pixel of the model, or 10 times the noise if that is more."));
  }

  function neighbors(row, box) {
    // position angle of +y of the prior
    const found = [], near = Math.cos(row.dec * Math.PI / 180), turn = (facts.turn || 0) * Math.PI / 180;
    for (const other of rows) {
      const north = (other.dec - row.dec) * 3600, east = (other.ra - row.ra) * 3600 * near;
      const up = north * Math.cos(turn) + east * Math.sin(turn), left = east * Math.cos(turn) - north * Math.sin(turn);
      if (other === row || Math.abs(up) > box / 2 || Math.abs(left) > box / 2) continue;
      const style = "left:" + (50 - 100 * left / box) + "%;top:" + (50 - 100 * up / box) + "%";
      found.push(make("a", { style, href: "#" + encodeURIComponent(other.id), title: "source " + other.id + (study ? ", " + facts.prior + " = " + number(other.mag, 1) : ""),
        onclick: (event) => { event.preventDefault(); choose(other, true); } }));
    }
    return found;
  }

  // ------------------------------------------------------------------ figures

  const scaled = (low, high, from, to) => (value) => from + (value - low) / (high - low) * (to - from);

  function stepOf(span, n) {
    const rough = span / n, power = 10 ** Math.floor(Math.log10(rough));
    return power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  }

  function legend(x, y, entries) {
    return entries.map(([label, mark], k) => draw("g", { transform: "translate(" + x + "," + (y + 15 * k) + ")" },
      mark, draw("text", { x: 24, y: 4 }, label)));
  }

  function spectrum(entry) {
    const width = 700, height = 400, left = 58, right = 12, top = 10, bottom = 38;
    const log = Math.log10, wave = facts.wave;
    const lowest = [], positive = [];
    bands.forEach((band, k) => {
      for (const value of [entry.true[k], entry.flux[k] > entry.error[k] ? entry.flux[k] : 3 * entry.error[k]]) if (value > 0) positive.push(value);
      if (entry.flux[k] > entry.error[k]) lowest.push(entry.flux[k]);
    });
    if (!positive.length) return make("p", {}, "There is no flux to show.");
    const least = (k) => entry.upper ? facts.detected * entry.error[k] : entry.error[k];
    const low = log(Math.min(...(lowest.length ? lowest : positive), ...entry.true.filter((v) => v > 0))) - 0.45, high = log(Math.max(...positive)) + 0.45;
    const x = scaled(log(wave[0]), log(wave[wave.length - 1]), left, width - right), y = scaled(low, high, height - bottom, top);
    const parts = [];
    for (const value of [0.3, 0.5, 1, 2, 3, 5, 10, 20, 30, 50, 100]) {
      if (value < wave[0] || value > wave[wave.length - 1]) continue;
      parts.push(draw("line", { class: "tick", x1: x(log(value)), x2: x(log(value)), y1: top, y2: height - bottom }),
        draw("text", { x: x(log(value)), y: height - bottom + 15, "text-anchor": "middle" }, String(value)));
    }
    for (let power = Math.ceil(low); power <= high; power += 1) {
      parts.push(draw("line", { class: "tick", x1: left, x2: width - right, y1: y(power), y2: y(power) }),
        draw("text", { x: left - 6, y: y(power) + 4, "text-anchor": "end" }, Math.abs(power) > 4 ? "1e" + power : String(Number((10 ** power).toPrecision(1)))));
    }
    parts.push(draw("rect", { class: "axis", x: left, y: top, width: width - left - right, height: height - top - bottom }),
      draw("text", { x: (left + width) / 2, y: height - 6, "text-anchor": "middle" }, "observed wavelength (µm)"),
      draw("text", { transform: "translate(14," + (height - bottom) / 2 + ") rotate(-90)", "text-anchor": "middle" }, "flux density (µJy)"));
    const clip = draw("g", { "clip-path": "url(#inside)" }), entries = [];
    for (const name of [...facts.compared].reverse()) {
      const fit = entry.fits && entry.fits[name];
      if (!fit) continue;
      let path = "";
      fit.spectrum.forEach((value, k) => {
        if (value === null) return;
        path += (k && fit.spectrum[k - 1] !== null ? "L" : "M") + x(log(wave[k])).toFixed(1) + " " + y(value / 1000).toFixed(1);
      });
      const style = { fill: "none", stroke: setOf[name].color, "stroke-width": 1.4, "stroke-dasharray": DASHES[name] };
      clip.append(draw("path", { d: path, ...style }));
      entries.unshift(["best model " + setOf[name].label, draw("line", { x1: 0, x2: 20, ...style })]);
    }
    const truth = { fill: "none", stroke: "#6b7280" };
    bands.forEach((band, k) => {
      const cx = x(log(band.wave)), flux = entry.flux[k], error = entry.error[k], color = band.miri ? "#9a3412" : "#1c2330";
      const title = draw("title", {}, band.label + ": " + number(flux) + " ± " + number(error) + " µJy, " + (study ? "true " + number(entry.true[k]) : "limit " + number(entry.upper[k])));
      const group = draw("g", {}, title);
      if (entry.true[k] > 0) group.append(draw("rect", { x: cx - 5, y: y(log(entry.true[k])) - 5, width: 10, height: 10, ...truth }));
      if (flux !== null && error > 0) {
        if (flux > least(k)) {
          const cy = y(log(flux));
          group.append(draw("line", { x1: cx, x2: cx, y1: y(log(flux + error)), y2: y(log(flux - error)), stroke: color }), point(cx, cy, band.miri, color));
        } else {
          const cy = y(log(entry.upper ? entry.upper[k] : 3 * error));
          group.append(draw("path", { d: "M" + (cx - 5) + " " + cy + "h10m-5 0v16m-4 -6l4 6l4 -6", stroke: color, fill: "none" }));
        }
      }
      clip.append(group);
    });
    entries.push([study ? "MIRI" : "measured", point(10, 0, true, "#9a3412")]);
    if (study) entries.push(["existing bands", point(10, 0, false, "#1c2330")], ["true flux", draw("rect", { x: 5, y: -5, width: 10, height: 10, ...truth })]);
    const clipping = draw("clipPath", { id: "inside" }, draw("rect", { x: left, y: top, width: width - left - right, height: height - top - bottom }));
    return make("div", {}, draw("svg", { viewBox: "0 0 " + width + " " + height, role: "img", "aria-label": "spectral energy distribution" },
      clipping, parts, clip, legend(left + 12, top + 14, entries)),
      make("p", { class: "note" }, study ? "Arrows: three times the error, where the flux is below its error. "
        + (entry.fits ? "Models are means over cells of " + (100 * (wave[1] / wave[0] - 1)).toFixed(1) + " % in wavelength." : "Existing bands have mock fluxes for fitted sources only.") : "Arrows: upper limits, " + facts.limits + "."));
  }

  function point(x, y, miriBand, color) {
    return miriBand ? draw("path", { d: "M" + (x - 5) + " " + y + "l5 -5l5 5l-5 5z", fill: color }) : draw("circle", { cx: x, cy: y, r: 3.6, fill: color });
  }

  function posteriors(row, entry) {
    if (!entry.fits) return make("p", {}, "There is no fit; see above for the reason.");
    const drawn = [["redshift", "redshift", row.redshift], ["frac_agn", "fracAGN", row.frac_agn]];
    const first = sets[0].name;
    return make("div", {},
      make("div", { class: "pair" }, drawn.filter(([name]) => name in facts.pdf_edges[first]).map(([name, label, truth]) => posterior(entry, name, label, truth))),
      make("p", { class: "note" }, sets.filter((set) => entry.fits[set.name]).map((set) => make("span", { style: "margin-right:1em;white-space:nowrap" },
        draw("svg", { viewBox: "0 0 30 6", style: "display:inline;width:30px;height:6px;margin-right:.4em" },
          draw("line", { x1: 0, x2: 30, y1: 3, y2: 3, stroke: set.color, "stroke-width": 2, "stroke-dasharray": DASHES[set.name] })), set.label)),
        make("span", { style: "white-space:nowrap" }, "┆ truth")));
  }

  function posterior(entry, name, label, truth) {
    const width = 360, height = 210, left = 10, right = 10, top = 8, bottom = 36;
    const curves = [];
    for (const set of sets) {
      const fit = entry.fits[set.name];
      if (!fit || !fit.pdf[name]) continue;
      const edges = facts.pdf_edges[set.name][name], [start, weights] = fit.pdf[name];
      curves.push({ set, edges: edges.slice(start, start + weights.length + 1), density: weights.map((w, k) => w / (edges[start + k + 1] - edges[start + k])) });
    }
    const shown = curves.filter((curve) => curve.density.length);
    if (!shown.length) return make("p", {}, "no posterior");
    let low = 0, high = 1;
    if (name === "redshift") {
      const ends = shown.flatMap((curve) => [curve.edges[0], curve.edges[curve.edges.length - 1]]).concat(truth === null ? [] : [truth]);
      low = Math.min(...ends); high = Math.max(...ends);
      const margin = Math.max(0.03, 0.06 * (high - low));
      low = Math.max(0, low - margin); high += margin;
    }
    const tall = Math.max(...shown.flatMap((curve) => curve.density));
    const x = scaled(low, high, left, width - right), y = scaled(0, 1.06 * tall, height - bottom, top);
    const parts = [], step = stepOf(high - low, 6);
    for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + 1e-9; value += step) {
      parts.push(draw("line", { class: "tick", x1: x(value), x2: x(value), y1: top, y2: height - bottom }),
        draw("text", { x: x(value), y: height - bottom + 15, "text-anchor": "middle" }, String(Number(value.toFixed(6)))));
    }
    for (const { set, edges, density } of [...shown].reverse()) {
      let path = "M" + x(edges[0]).toFixed(1) + " " + y(0);
      density.forEach((value, k) => { path += "V" + y(value).toFixed(1) + "H" + x(edges[k + 1]).toFixed(1); });
      const main = facts.compared.includes(set.name);
      parts.push(draw("path", { d: path + "V" + y(0), fill: main ? set.color : "none", "fill-opacity": 0.13, stroke: set.color, "stroke-width": 1.5, "stroke-dasharray": DASHES[set.name] }, draw("title", {}, set.label)));
    }
    if (truth !== null && truth >= low && truth <= high) {
      parts.push(draw("line", { class: "truth", x1: x(truth), x2: x(truth), y1: top, y2: height - bottom, stroke: "#1c2330", "stroke-dasharray": "4 3" }, draw("title", {}, "truth " + number(truth))));
    }
    parts.push(draw("rect", { class: "axis", x: left, y: top, width: width - left - right, height: height - top - bottom }),
      draw("text", { x: width / 2, y: height - 4, "text-anchor": "middle" }, label));
    return draw("svg", { viewBox: "0 0 " + width + " " + height, role: "img", "aria-label": "posterior of " + label }, parts);
  }

  // ------------------------------------------------------------------ tables and flags of a source

  function fluxes(entry) {
    let k = -1;
    const body = bands.map((band, i) => {
      const noted = [];
      if (band.miri) {
        k += 1;
        noted.push(...words("condition", entry.conditions[k]), ...words("photometry", entry.flags[k] < 0 ? 0 : entry.flags[k]));
      }
      const ratio = entry.error[i] > 0 && entry.flux[i] !== null ? entry.flux[i] / entry.error[i] : null;
      return make("tr", {}, make("td", { class: "t" }, band.miri ? band.label : band.name), make("td", {}, number(band.wave)), make("td", {}, number((entry.upper || entry.true)[i])),
        make("td", {}, number(entry.flux[i])), make("td", {}, number(entry.error[i])), make("td", {}, number(ratio, 1)), make("td", { class: "t" }, [...new Set(noted)].join(", ")));
    });
    return make("div", { class: "scrolls" }, make("table", { class: "values" },
      make("thead", {}, make("tr", {}, ["band", "µm", study ? "true" : "upper limit", "measured", "error", "S/N", "flags"].map((text, j) => make("th", { class: j === 0 || j === 6 ? "t" : null }, text)))),
      make("tbody", {}, body)));
  }

  // nominal solar luminosity (IAU 2015) in the units that luminosities come in
  const SUN = { W: 3.828e26, "erg / s": 3.828e33 };
  const raised = (power) => "10" + [...String(power)].map((c) => c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[c]).join("");

  function parameters(entry) {
    const own = sets.filter((set) => entry.fits && entry.fits[set.name]);
    const body = facts.parameters.map((parameter, k) => {
      const sun = SUN[parameter.unit] || 1, over = (value) => value === null ? null : value / sun;
      const truth = over(entry.parameters[k]), moments = own.map((set) => entry.fits[set.name].moments[k].map(over));
      // one power of ten for the row, and two digits of the error
      const most = Math.max(...[truth, ...moments.map((pair) => pair[0])].map((value) => Math.abs(value || 0)));
      const size = most > 0 ? Math.floor(Math.log10(most)) : 0, power = size > 4 || size < -3 ? size : 0;
      const unit = sun === 1 ? parameter.unit.replaceAll("solMass", "M☉") : "L☉";
      const label = [power ? raised(power) : "", unit].filter(Boolean).join(" "), cut = (value) => value === null ? null : value / 10 ** power;
      return make("tr", {},
        make("td", { class: "t" }, parameter.name.replaceAll("_", " ") + (label ? " (" + label + ")" : "")),
        make("td", {}, number(cut(truth))),
        moments.map(([mean, std]) => {
          // what rounding leaves of a parameter with one value
          const width = std !== null && std < 1e-6 * Math.abs(mean) ? 0 : cut(std);
          const digits = width > 0 ? Math.max(0, Math.min(6, 1 - Math.floor(Math.log10(width)))) : undefined;
          return make("td", {}, number(cut(mean), digits) + " ± " + number(width, digits));
        }));
    });
    return make("div", { class: "scrolls" }, make("table", { class: "values" },
      make("thead", {}, make("tr", {}, make("th", { class: "t" }, "parameter"), make("th", {}, "true"), own.map((set) => make("th", {}, set.label)))),
      make("tbody", {}, body)),
      own.length ? make("p", { class: "note" }, "Means and standard deviations of the posteriors.") : null);
  }

  function flags(row, entry) {
    const lines = new Map();
    const add = (kind, value, where) => {
      for (const [word, text] of bits(kind, value)) {
        const key = kind + word;
        if (!lines.has(key)) lines.set(key, { word, text, where: [] });
        if (where) lines.get(key).where.push(where);
      }
    };
    add("selection", row.selection);
    miri.forEach((band, k) => add("condition", entry.conditions[k], band.label));
    miri.forEach((band, k) => add("photometry", entry.flags[k] < 0 ? 0 : entry.flags[k], band.label));
    add("association", row.association);
    for (const set of sets) add("fit", row["fit_" + set.name], "fit " + set.label);
    if (!lines.size) return make("p", {}, "none");
    return make("ul", {}, [...lines.values()].map(({ word, text, where }) => make("li", {}, make("b", {}, word),
      (where.length === miri.length && miri.length > 1 && !where[0].startsWith("fit") ? " (all bands)" : where.length ? " (" + where.join(", ") + ")" : "") + ": " + text)));
  }

  // ------------------------------------------------------------------ the page

  function setControls() {
    $("show").value = state.show;
    $("flag").value = state.flag;
    $("text").value = state.text;
    for (const column of columns) $("range-" + column.key).value = state.ranges[column.key] || "";
  }

  function follow() {
    readAddress();
    setControls();
    apply();
    const row = state.id === null ? listed[0] : byId.get(state.id);
    if (row) choose(row, true);
    else $("detail").replaceChildren(make("p", {}, state.id === null ? "No source to show." : "There is no source " + state.id + "."));
  }

  for (const [name, [label]] of Object.entries(shows)) $("show").append(make("option", { value: name }, label));
  const known = [...new Set(rows.flatMap((row) => row.words))].sort();
  $("flag").append(make("option", { value: "" }, "any or none"), ...known.map((word) => make("option", { value: word }, word)));
  $("truths").append(...facts.truths.map((name) => name === facts.truth ? make("b", {}, name) : make("a", { href: "sources-" + encodeURIComponent(name) + ".html" }, name)));
  buildTable();
  $("show").addEventListener("change", (event) => { state.show = event.target.value; apply(); });
  $("flag").addEventListener("change", (event) => { state.flag = event.target.value; apply(); });
  $("text").addEventListener("input", (event) => { state.text = event.target.value; apply(); });
  $("clear").addEventListener("click", () => { state = { ...blank(), id: state.id, sort: state.sort, down: state.down }; setControls(); apply(); });
  $("scroll").addEventListener("scroll", render);
  new ResizeObserver(render).observe($("scroll"));
  window.addEventListener("hashchange", follow);
  document.addEventListener("keydown", (event) => {
    const typing = ["INPUT", "SELECT"].includes(event.target.tagName);
    if (event.key === "Escape" && typing) event.target.blur();
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    const page = Math.max(1, Math.floor($("scroll").clientHeight / ROW) - 4);
    const steps = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -Infinity, End: Infinity };
    if (event.key in steps) { event.preventDefault(); move(steps[event.key]); }
    if (event.key === "/") { event.preventDefault(); $("text").focus(); }
  });
  follow();
})();
