"use strict";
// A list of sources with filters, and what is known of one of them. Columns, choices and texts are of the page
// (`facts`). Details and pictures are in files of `facts.chunk` sources each, which are loaded as scripts and
// images, since a page of the file system can read no other data.
(function () {
  const facts = JSON.parse(document.getElementById("facts").textContent);
  const { table, columns, shows, bands, sets, notes } = facts;
  const measured = bands.filter((band) => band.miri);
  const ROW = 24, KEPT = 40;
  const $ = (id) => document.getElementById(id);
  const missing = (value) => value === null || value === undefined || value === "";

  function fill(node, attributes, children) {
    for (const [name, value] of Object.entries(attributes || {})) {
      if (value === null || value === undefined || value === false) continue;
      if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
      else node.setAttribute(name, value);
    }
    node.append(...children.flat(Infinity).filter((child) => !missing(child)));
    return node;
  }

  const make = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);
  const draw = (tag, attributes, ...children) => fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);

  function number(value, digits) {
    if (missing(value)) return "–";
    if (typeof value === "string") return value;
    const size = Math.abs(value);
    let text = String(Number(value.toPrecision(4)));
    if (digits !== undefined && digits !== null) text = value.toFixed(digits);
    else if (size !== 0 && (size >= 1e5 || size < 1e-3)) text = value.toExponential(2).replace("e+", "e");
    return text.replaceAll("-", "−");
  }

  // words and meanings of the bits of a flag
  function bits(kind, value) {
    const meanings = Object.entries(facts.flags[kind] || {});
    return meanings.filter(([bit]) => value > 0 && value & Number(bit)).map(([, meaning]) => meaning);
  }

  // ------------------------------------------------------------------ rows, and what the address says of them

  const rows = table.id.map((_, i) => {
    const row = { i };
    for (const name of Object.keys(table)) row[name] = table[name][i];
    const named = facts.flag_columns.flatMap(([column, kind]) => bits(kind, row[column]));
    row.words = [...new Set(named.map(([word]) => word))];
    row.flags = row.words.join(", ");
    return row;
  });
  const byId = new Map(rows.map((row) => [String(row.id), row]));
  let chosen = null, listed = [], state = new URLSearchParams();

  function setState(name, value) {
    if (value) state.set(name, value);
    else state.delete(name);
    apply();
  }

  function writeAddress() {
    const query = state.toString(), row = byId.get(chosen);
    const text = "#" + (chosen === null ? "" : encodeURIComponent(chosen)) + (query ? "?" + query : "");
    $("hidden").textContent = row && !listed.includes(row) ? "Source " + chosen + ", shown below, is not in the list: the filters leave it out." : "";
    if (text !== location.hash) history.replaceState(null, "", text);
    for (const link of $("truths").querySelectorAll("a")) link.hash = text;
  }

  // what a range such as 0.5..2, >5, <=1 or a value asks for; null where it cannot be read
  function range(text) {
    const plain = text.replaceAll("−", "-").replaceAll(" ", "");
    const span = plain.match(/^(.*?)\.\.(.*)$/), side = plain.match(/^([<>]=?)(.+)$/);
    let low = -Infinity, high = Infinity;
    if (span && span[1]) low = Number(span[1]);
    if (span && span[2]) high = Number(span[2]);
    if (!span && side && side[1].startsWith("<")) high = Number(side[2]);
    else if (!span && side) low = Number(side[2]);
    else if (!span) low = high = Number(plain.replace("=", ""));
    if (isNaN(low) || isNaN(high)) return null;
    const open = !span && side && side[1].length === 1;
    return (value) => open ? value > low && value < high : value >= low && value <= high;
  }

  function testOf(column, text) {
    if (column.text || typeof table[column.key][0] === "string") {
      return (row) => String(row[column.key]).toLowerCase().includes(text.toLowerCase());
    }
    const wanted = range(text);
    return wanted && ((row) => !missing(row[column.key]) && wanted(row[column.key]));
  }

  function apply() {
    const show = shows[state.get("show")] || Object.values(shows)[0];
    const tests = [(row) => !show[1] || row[show[1]]];
    const flag = state.get("flag"), parts = (state.get("text") || "").toLowerCase().split(/\s+/).filter(Boolean);
    if (flag) tests.push((row) => row.words.includes(flag));
    tests.push((row) => parts.every((part) => String(row.id).toLowerCase() === part || row.flags.includes(part)));
    for (const column of columns) {
      const text = (state.get(column.key) || "").trim(), test = text && testOf(column, text);
      $("range-" + column.key).setAttribute("aria-invalid", String(Boolean(text) && !test));
      if (test) tests.push(test);
    }
    const order = state.get("sort") || "id", key = order.replace(/^-/, ""), sign = order === key ? 1 : -1;
    listed = rows.filter((row) => tests.every((test) => test(row)));
    listed.sort((a, b) => {
      const x = a[key], y = b[key];
      // what has no value comes last in either direction
      if (missing(x) || missing(y)) return missing(x) - missing(y) || a.i - b.i;
      return sign * (typeof x === "string" ? x.localeCompare(y) : x - y) || a.i - b.i;
    });
    $("count").textContent = listed.length + " of " + rows.length + " sources";
    for (const button of $("list").querySelectorAll("thead button")) {
      const sorted = button.dataset.key !== key ? "none" : sign > 0 ? "ascending" : "descending";
      button.querySelector("span").textContent = { none: "", ascending: " ↑", descending: " ↓" }[sorted];
      button.closest("th").setAttribute("aria-sort", sorted);
    }
    writeAddress();
    render();
  }

  // ------------------------------------------------------------------ the list: only rows in sight are made

  const cellClass = (column, off) => [column.text ? "t" : "", column.first ? "first" : "", off ? "outlier" : ""].join(" ").trim();

  function buildList() {
    columns.forEach((column, k) => { column.first = k > 0 && columns[k - 1].group !== column.group; });
    const first = columns.filter((column, k) => k === 0 || column.first);
    const starts = [...first.map((column) => columns.indexOf(column)), columns.length];
    $("list").tHead.append(
      make("tr", { class: "group" }, first.map((column, k) => make("th", { colspan: starts[k + 1] - starts[k], class: cellClass(column) }, column.group))),
      make("tr", {}, columns.map((column) => make("th", { class: cellClass(column), title: column.title },
        make("button", { type: "button", "data-key": column.key,
          onclick: () => setState("sort", (state.get("sort") || "id") === column.key ? "-" + column.key : column.key) }, column.label, make("span"))))),
      make("tr", {}, columns.map((column) => make("th", { class: cellClass(column) },
        make("input", { id: "range-" + column.key, "aria-label": "filter of " + column.group + " " + column.label,
          oninput: (event) => setState(column.key, event.target.value) })))));
  }

  function cell(row, column) {
    const value = row[column.key], off = column.off && row[column.off];
    const shown = (row[column.limit] ? "> " : "") + (column.key === "id" ? String(value) : number(value, column.digits));
    return make("td", { class: cellClass(column, off), title: column.text ? value : null }, column.text && !value ? "" : shown);
  }

  function render() {
    const box = $("scroll");
    const start = Math.max(0, Math.floor(box.scrollTop / ROW) - 8);
    const stop = Math.min(listed.length, start + Math.ceil(box.clientHeight / ROW) + 16);
    const spacer = (n) => make("tr", { "aria-hidden": "true", style: "height:" + n * ROW + "px" }, make("td", { colspan: columns.length, style: "border:0;height:auto" }));
    $("list").tBodies[0].replaceChildren(spacer(start),
      ...listed.slice(start, stop).map((row) => make("tr", { class: String(row.id) === chosen ? "chosen" : null, onclick: () => choose(row) },
        columns.map((column) => cell(row, column)))),
      spacer(listed.length - stop));
  }

  function choose(row) {
    chosen = String(row.id);
    const at = listed.indexOf(row), box = $("scroll"), height = box.clientHeight - $("list").tHead.offsetHeight;
    if (at >= 0 && at * ROW < box.scrollTop) box.scrollTop = at * ROW;
    if (at >= 0 && (at + 1) * ROW > box.scrollTop + height) box.scrollTop = (at + 1) * ROW - height;
    writeAddress();
    render();
    withFile(Math.floor(row.i / facts.chunk), (file) => {
      if (String(row.id) === chosen) showDetails(row, file.entries[row.i % facts.chunk], file.image);
    });
  }

  function move(step) {
    const now = listed.indexOf(byId.get(chosen));
    const next = now < 0 ? 0 : Math.min(listed.length - 1, Math.max(0, now + step));
    if (listed.length) choose(listed[next]);
  }

  // ------------------------------------------------------------------ details, loaded by file

  const files = new Map();
  const stem = (k) => facts.folder + "/" + String(k).padStart(3, "0");

  window.loaded = (k, entries) => {
    const file = files.get(k);
    if (!file) return;
    file.entries = entries;
    file.then.forEach((go) => go(file));
  };

  function withFile(k, go) {
    let file = files.get(k);
    if (!file) {
      file = { entries: null, then: [], image: new Image() };
      // pictures of a large field would fill the memory: those that were looked at long ago are loaded again
      if (files.size >= KEPT) files.delete(files.keys().next().value);
      files.set(k, file);
      if (facts.cutouts) file.image.src = stem(k) + ".png";
      document.head.append(make("script", { src: stem(k) + ".js", onerror: () => {
        files.delete(k);
        $("detail").replaceChildren(make("p", { class: "why" }, "The file " + stem(k) + ".js, which belongs to this page, is not there."));
      } }));
    }
    if (file.entries) go(file);
    else file.then.push(go);
  }

  function showDetails(row, entry, image) {
    const section = (title, ...content) => make("section", {}, make("h3", {}, title), ...content);
    const items = facts.heading.map(([key, label, digits]) => make("span", {}, label + " ", make("b", {}, number(row[key], digits))));
    const why = bits("selection", row.selection).map(([word, text]) => make("li", {}, make("b", {}, word), ": " + text));
    const pictures = facts.cutouts ? [make("h3", {}, "Images"), cutouts(row, entry, image)] : [];
    $("detail").replaceChildren(
      make("section", { class: "wide" }, make("h2", {}, "Source " + row.id), make("div", { class: "facts" }, items),
        why.length ? make("div", { class: "why" }, "Not fitted:", make("ul", {}, why)) : null, pictures),
      section(sets.length ? "Photometry and models" : "Photometry", spectrum(entry)),
      make("section", {}, facts.pdf_edges ? [make("h3", {}, "Posteriors"), posteriors(row, entry)] : null,
        facts.flag_columns.length ? [make("h3", {}, "Flags"), flags(row, entry)] : null,
        facts.parameters && !facts.pdf_edges ? [make("h3", {}, "Parameters"), parameters(entry)] : null),
      section("Fluxes (µJy)", fluxes(entry)),
      facts.parameters && facts.pdf_edges ? section("Parameters", parameters(entry)) : "");
  }

  function cutouts(row, entry, image) {
    const c = facts.cutouts, y0 = (row.i % facts.chunk) * c.height, ring = 200 / c.box;
    if (!entry.top) return make("p", {}, entry.imaged ? notes.pictured : "No band has data at this position.");
    function cut(x, y, n) {
      const canvas = make("canvas", { width: n, height: n });
      const paint = () => canvas.getContext("2d").drawImage(image, x, y0 + y, n, n, 0, 0, n, n);
      if (image.complete && image.naturalWidth) paint();
      else image.addEventListener("load", paint, { once: true });
      return make("span", { class: "cut", style: "--ring:" + ring + "%;--off:" + (50 - ring / 2) + "%" }, canvas);
    }
    const limits = (k) => number(c.lowest * c.sigma[k]) + " to " + number(entry.top[k]);
    const prior = cut(0, 0, c.prior);
    prior.append(...neighbors(row, c.box));
    const size = Math.max(60, Math.min(150, Math.floor(($("detail").clientWidth - 70) / (measured.length + 2))));
    return [make("div", { class: "cutouts" },
      make("div", { class: "prior", style: "width:" + 2 * size + "px" }, make("b", {}, facts.prior + " (prior)"), prior, limits(0)),
      make("div", { class: "bands", style: "grid-template-columns: 1.1rem repeat(" + measured.length + ", " + size + "px)" },
        make("span"), measured.map((band) => make("b", {}, band.label)),
        ["mosaic", "model", "residual"].map((label, r) => [make("span", { class: "side" }, label), measured.map((_, k) => cut(c.prior + k * c.side, r * c.side, c.side))]),
        make("span"), measured.map((_, k) => make("span", {}, limits(k + 1))))),
    make("p", { class: "note" }, notes.images)];
  }

  function neighbors(row, box) {
    // position angle of +y of the prior
    const turn = (facts.turn || 0) * Math.PI / 180, near = Math.cos(row.dec * Math.PI / 180);
    return rows.filter((other) => other !== row).map((other) => {
      const north = (other.dec - row.dec) * 3600, east = (other.ra - row.ra) * 3600 * near;
      const up = north * Math.cos(turn) + east * Math.sin(turn), left = east * Math.cos(turn) - north * Math.sin(turn);
      if (Math.max(Math.abs(up), Math.abs(left)) > box / 2) return null;
      const style = "left:" + (50 - 100 * left / box) + "%;top:" + (50 - 100 * up / box) + "%";
      return make("a", { style, href: "#" + encodeURIComponent(other.id), title: "source " + other.id, onclick: (event) => { event.preventDefault(); choose(other); } });
    }).filter(Boolean);
  }

  // ------------------------------------------------------------------ figures

  // axes with ticks (value, place between 0 and 1, text) and what is drawn by a function of the places x and y
  function figure(width, height, left, labels, ticks, content) {
    const right = width - 12, top = 8, bottom = height - 38;
    const x = (part) => left + part * (right - left), y = (part) => bottom - part * (bottom - top);
    const line = (x1, x2, y1, y2) => draw("line", { class: "tick", x1, x2, y1, y2 });
    const box = { x: left, y: top, width: right - left, height: bottom - top };
    return draw("svg", { viewBox: "0 0 " + width + " " + height, role: "img", "aria-label": labels.title },
      draw("clipPath", { id: labels.title }, draw("rect", box)),
      ticks.x.map(([part, text]) => [line(x(part), x(part), top, bottom), draw("text", { x: x(part), y: bottom + 15, "text-anchor": "middle" }, text)]),
      ticks.y.map(([part, text]) => [line(left, right, y(part), y(part)), draw("text", { x: left - 6, y: y(part) + 4, "text-anchor": "end" }, text)]),
      draw("g", { "clip-path": "url('#" + labels.title + "')" }, content(x, y)), draw("rect", { class: "axis", ...box }),
      draw("text", { x: (left + right) / 2, y: height - 5, "text-anchor": "middle" }, labels.x),
      draw("text", { transform: "translate(14," + (top + bottom) / 2 + ") rotate(-90)", "text-anchor": "middle" }, labels.y));
  }

  const key = (text, color) => make("span", { class: "key", style: "color:" + color }, text);
  const lines = (entry) => sets.filter((set) => entry.fits && entry.fits[set.name]);
  const stroke = (set) => ({ fill: "none", stroke: set.color, "stroke-width": 1.5, "stroke-dasharray": set.dash });

  function spectrum(entry) {
    const wave = facts.wave, log = Math.log10, first = log(wave[0]), last = log(wave[wave.length - 1]);
    const limit = (k) => entry.upper ? entry.upper[k] : 3 * entry.error[k];
    const detected = (k) => entry.flux[k] > (facts.detected || 1) * entry.error[k];
    const truths = entry.true || bands.map(() => null);
    const values = bands.flatMap((_, k) => [truths[k], detected(k) ? entry.flux[k] : limit(k)]).filter((value) => value > 0);
    if (!values.length) return make("p", {}, "There is no flux to show.");
    // models far in the blue would take all of the figure
    const high = log(Math.max(...values)) + 0.45, low = Math.max(log(Math.min(...values)) - 0.45, high - 5);
    const ofWave = (value) => (log(value) - first) / (last - first), ofFlux = (value) => (log(value) - low) / (high - low);
    const powers = Array.from({ length: Math.floor(high) - Math.ceil(low) + 1 }, (_, k) => Math.ceil(low) + k);
    const ticks = {
      x: [0.3, 0.5, 1, 2, 3, 5, 10, 20, 30, 50, 100, 300, 1000].filter((value) => value >= wave[0] && value <= wave[wave.length - 1]).map((value) => [ofWave(value), String(value)]),
      y: powers.map((power) => [ofFlux(10 ** power), Math.abs(power) > 4 ? "1e" + power : String(Number((10 ** power).toPrecision(1)))]),
    };
    const modeled = lines(entry).filter((set) => entry.fits[set.name].spectrum);
    const labels = { title: "spectral energy distribution", x: "observed wavelength (µm)", y: "flux density (µJy)" };
    const picture = figure(700, 400, 58, labels, ticks, (x, y) => [
      [...modeled].reverse().map((set) => {
        const { spectrum: values } = entry.fits[set.name];
        const path = values.map((value, k) => value === null ? "" : (k && values[k - 1] !== null ? "L" : "M") + x(ofWave(wave[k])).toFixed(1) + " " + y((value / 1000 - low) / (high - low)).toFixed(1));
        return draw("path", { d: path.join(""), ...stroke(set) });
      }),
      bands.map((band, k) => {
        const cx = x(ofWave(band.wave)), color = band.miri ? "#9a3412" : "#1c2330", flux = entry.flux[k], error = entry.error[k];
        const text = band.label + ": " + number(flux) + " ± " + number(error) + " µJy" + (entry.true ? ", true " + number(truths[k]) : "");
        const parts = [draw("title", {}, text)];
        if (truths[k] > 0) parts.push(draw("rect", { x: cx - 5, y: y(ofFlux(truths[k])) - 5, width: 10, height: 10, fill: "none", stroke: "#6b7280" }));
        if (!missing(flux) && error > 0 && detected(k)) {
          const bottom = flux > error ? y(ofFlux(flux - error)) : y(0);
          parts.push(draw("line", { x1: cx, x2: cx, y1: y(ofFlux(flux + error)), y2: bottom, stroke: color }),
            draw("path", { d: "M" + (cx - 5) + " " + y(ofFlux(flux)) + "l5 -5l5 5l-5 5z", fill: color }));
        } else if (limit(k) > 0) parts.push(draw("path", { d: "M" + (cx - 5) + " " + y(ofFlux(limit(k))) + "h10m-5 0v16m-4 -6l4 6l4 -6", stroke: color, fill: "none" }));
        return draw("g", {}, parts);
      })]);
    return make("div", {}, picture, make("p", { class: "note" }, bands.some((band) => !band.miri) ? [key("◆ MIRI", "#9a3412"), key("◆ other bands", "#1c2330")] : key("◆ measured", "#9a3412"),
      entry.true ? key("□ true flux", "#6b7280") : "", modeled.map((set) => key("— best model " + set.label, set.color)), notes.spectrum));
  }

  function posteriors(row, entry) {
    if (!lines(entry).length) return make("p", {}, "There is no fit.");
    const names = Object.keys(facts.pdf_edges[lines(entry)[0].name]);
    return make("div", {}, make("div", { class: "pair" }, names.map((name) => posterior(entry, name, row[name]))),
      make("p", { class: "note" }, lines(entry).map((set) => key("— " + set.label, set.color)), missing(facts.line) ? "" : key("┆ " + facts.line, "#1c2330")));
  }

  function posterior(entry, name, truth) {
    const curves = [], width = 360, label = name === "frac_agn" ? "fracAGN" : name;
    for (const set of lines(entry)) {
      const edges = facts.pdf_edges[set.name][name], [start, weights] = (entry.fits[set.name].pdf || {})[name] || [0, []];
      const density = weights.map((weight, k) => weight / (edges[start + k + 1] - edges[start + k]));
      if (density.length) curves.push({ set, density, edges: edges.slice(start, start + density.length + 1) });
    }
    if (!curves.length) return make("p", {}, "no posterior of " + label);
    const ends = curves.flatMap((curve) => [curve.edges[0], curve.edges[curve.edges.length - 1], ...(missing(truth) ? [] : [truth])]);
    const margin = Math.max(0.02, 0.06 * (Math.max(...ends) - Math.min(...ends)));
    const low = Math.max(0, Math.min(...ends) - margin), span = Math.max(...ends) + margin - low;
    const power = 10 ** Math.floor(Math.log10(span / 6)), step = power * [1, 2, 5, 10].find((factor) => factor * power >= span / 6);
    const places = Array.from({ length: Math.floor((low + span) / step) - Math.ceil(low / step) + 1 }, (_, k) => (Math.ceil(low / step) + k) * step);
    const tall = 1.06 * Math.max(...curves.flatMap((curve) => curve.density)), part = (value) => (value - low) / span;
    const ticks = { x: places.map((value) => [part(value), String(Number(value.toFixed(6)))]), y: [] };
    return figure(width, 210, 10, { title: "posterior of " + label, x: label, y: "" }, ticks, (x, y) => [
      [...curves].reverse().map(({ set, density, edges }) => draw("path", { ...stroke(set), fill: set.color, "fill-opacity": 0.1,
        d: "M" + x(part(edges[0])) + " " + y(0) + density.map((value, k) => "V" + y(value / tall).toFixed(1) + "H" + x(part(edges[k + 1])).toFixed(1)).join("") + "V" + y(0) }, draw("title", {}, set.label))),
      missing(truth) ? null : draw("line", { class: "truth", x1: x(part(truth)), x2: x(part(truth)), y1: y(0), y2: y(1), stroke: "#1c2330", "stroke-dasharray": "4 3" })]);
  }

  // ------------------------------------------------------------------ tables and flags of a source

  function valueTable(header, body) {
    const cells = (tag, texts) => make("tr", {}, texts.map((text, k) => make(tag, { class: k ? null : "t" }, text)));
    return make("div", { class: "scrolls" }, make("table", { class: "values" }, make("thead", {}, cells("th", header)), make("tbody", {}, body.map((texts) => cells("td", texts)))));
  }

  function fluxes(entry) {
    const extra = entry.true ? ["true"] : entry.upper ? ["upper limit"] : [];
    return valueTable(["band", "µm", ...extra, "measured", "error", "S/N"], bands.map((band, k) => {
      const ratio = entry.error[k] > 0 && !missing(entry.flux[k]) ? entry.flux[k] / entry.error[k] : null;
      return [band.label, number(band.wave), ...extra.map(() => number((entry.true || entry.upper)[k])), number(entry.flux[k]), number(entry.error[k]), number(ratio, 1)];
    }));
  }

  function parameters(entry) {
    const body = facts.parameters.map(({ name, unit }, k) => [name.replaceAll("_", " ") + (unit ? " (" + unit + ")" : ""),
      ...(entry.parameters ? [number(entry.parameters[k])] : []),
      ...lines(entry).map((set) => { const [mean, std] = entry.fits[set.name].moments[k]; return number(mean) + " ± " + number(missing(std) ? std : Number(std.toPrecision(2))); })]);
    return [valueTable(["parameter", ...(entry.parameters ? ["true"] : []), ...lines(entry).map((set) => set.label)], body),
      make("p", { class: "note" }, "Means and standard deviations of the posteriors.")];
  }

  function flags(row, entry) {
    const found = new Map();
    const add = (kind, value, where) => bits(kind, value).forEach(([word, text]) => {
      if (!found.has(kind + word)) found.set(kind + word, { word, text, where: [] });
      if (where) found.get(kind + word).where.push(where);
    });
    for (const [column, kind, where] of facts.flag_columns) if (!(kind in (entry.bits || {}))) add(kind, row[column], where);
    for (const [kind, values] of Object.entries(entry.bits || {})) values.forEach((value, k) => add(kind, value, measured[k].label));
    if (!found.size) return make("p", {}, "none");
    return make("ul", {}, [...found.values()].map(({ word, text, where }) => make("li", {}, make("b", {}, word), where.length ? " (" + where.join(", ") + ")" : "", ": " + text)));
  }

  // ------------------------------------------------------------------ the page

  const controls = [["show", "change"], ["flag", "change"], ["text", "input"]];

  function follow() {
    const [id, query] = location.hash.slice(1).split("?");
    state = new URLSearchParams(query || "");
    for (const [name] of controls) $(name).value = state.get(name) || (name === "show" ? Object.keys(shows)[0] : "");
    for (const column of columns) $("range-" + column.key).value = state.get(column.key) || "";
    chosen = id ? decodeURIComponent(id) : null;
    apply();
    const row = chosen === null ? listed[0] : byId.get(chosen);
    if (row) choose(row);
    else $("detail").replaceChildren(make("p", {}, chosen === null ? "No source to show." : "There is no source " + chosen + "."));
  }

  for (const [name, [label]] of Object.entries(shows)) $("show").append(make("option", { value: name }, label));
  const known = [...new Set(rows.flatMap((row) => row.words))].sort();
  $("flag").append(make("option", { value: "" }, "any or none"), ...known.map((word) => make("option", { value: word }, word)));
  $("truths").append(...(facts.truths || []).map((name) => name === facts.own ? make("b", {}, name) : make("a", { href: "sources-" + encodeURIComponent(name) + ".html" }, name)));
  buildList();
  for (const [name, event] of controls) $(name).addEventListener(event, () => setState(name, $(name).value));
  $("clear").addEventListener("click", () => { location.hash = chosen === null ? "" : encodeURIComponent(chosen); });
  $("scroll").addEventListener("scroll", render);
  new ResizeObserver(render).observe($("scroll"));
  window.addEventListener("hashchange", follow);
  document.addEventListener("keydown", (event) => {
    const typing = ["INPUT", "SELECT"].includes(event.target.tagName), page = Math.max(1, Math.floor($("scroll").clientHeight / ROW) - 4);
    const steps = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -Infinity, End: Infinity };
    if (event.key === "Escape" && typing) event.target.blur();
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in steps) { event.preventDefault(); move(steps[event.key]); }
    if (event.key === "/") { event.preventDefault(); $("text").focus(); }
  });
  follow();
})();
