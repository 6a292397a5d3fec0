// Results of the search page: ranked by what a reader typed, with excerpts, also when the site is opened from disk.
//
// Sphinx finds candidates by words and would request each page for its excerpt. Here the texts of all pages come from
// page_texts.js, so that words with signs in them ("rad/s", "--json") are searched for literally.
"use strict";

(function () {
  const EXCERPT_LENGTH = 240;
  const LETTER = "[\\p{Letter}\\p{Number}_]";
  const TITLE_SCORE = 30;  // of a result whose title contains the query
  const KEY_SCORE = 10;  // of keys and names of the interface
  const MAX_COUNT_SCORE = 10;  // of the number of occurrences in a text, relative to its length
  const SATURATION_LENGTH = 4000;  // letters of text for which one more occurrence is needed for the same score

  function escapeRegExp(text) {
    return text.replace(/[.*+?^${}()|[\]\\\/]/g, "\\$&");
  }

  // A word with signs is matched as it is, but not as a part of another word: "rad/s" is not in "rad/s²".
  function createPattern(word, flags) {
    const isLiteral = /[^\p{Letter}\p{Number}_]/u.test(word);
    const start = /^[\p{Letter}\p{Number}_]/u.test(word) ? "(?<!" + LETTER + ")" : "";
    const end = isLiteral && /[\p{Letter}\p{Number}_]$/u.test(word) ? "(?!" + LETTER + ")" : "";
    return {isLiteral: isLiteral, expression: new RegExp(start + escapeRegExp(word) + end, flags)};
  }

  // The part of a page that a result refers to: from its anchor to the next one for keys, else the whole page.
  function findText(item) {
    const page = pageTexts[item[0]];
    if (!page) { return ""; }
    const start = page.anchors[item[2].slice(1)];
    if (start === undefined) { return page.text; }
    const isObject = item[6] === "object";
    const next = Object.values(page.anchors).filter((offset) => offset > start);
    return page.text.slice(start, isObject && next.length ? Math.min(...next) : undefined);
  }

  function scoreItem(item, words) {
    const text = findText(item);
    let score = 0;
    for (const word of words) {
      const {isLiteral, expression} = createPattern(word, "giu");
      const isInTitle = item[1].search(expression) >= 0;
      const count = (text.match(expression) || []).length;
      if (isLiteral && !isInTitle && !count) { return null; }
      score += isInTitle ? TITLE_SCORE * Math.sqrt(word.length / item[1].length) : 0;
      score += MAX_COUNT_SCORE * count / (count + 1 + text.length / SATURATION_LENGTH);
    }
    return score + (item[6] === "object" ? KEY_SCORE : 0);
  }

  function rankResults(results, words) {
    const scored = results.map((item) => [scoreItem(item, words), item]);
    const matching = scored.filter((pair) => pair[0] !== null);
    const shown = matching.length ? matching : scored;
    shown.sort((a, b) => b[0] - a[0] || a[1][1].localeCompare(b[1][1]));
    return shown.map((pair) => pair[1]);
  }

  function createExcerpt(item, words) {
    let text = findText(item);
    const title = item[6] === "object" ? item[1].replace(/ \[.*\]$/, "") : item[1].split(" > ").pop();
    if (text.startsWith(title)) { text = text.slice(title.length); }
    text = text.trim();
    const places = words.map((word) => text.search(createPattern(word, "iu").expression)).filter((place) => place >= 0);
    const first = places.length ? Math.min(...places) : 0;
    let start = first < EXCERPT_LENGTH / 2 ? 0 : first - EXCERPT_LENGTH / 3;
    if (start) { start = text.indexOf(" ", start) + 1; }
    let end = start + EXCERPT_LENGTH;
    if (end < text.length) { end = text.slice(0, end).search(/\s\S*$/); }
    return (start ? "\u2026 " : "") + text.slice(start, end).replace(/\n/g, " ") + (end < text.length ? " \u2026" : "");
  }

  function createListItem(item, words) {
    const [docName, title, anchor, description, , , kind] = item;
    const listItem = document.createElement("li");
    listItem.classList.add("kind-" + kind);
    const link = listItem.appendChild(document.createElement("a"));
    link.href = docName + DOCUMENTATION_OPTIONS.LINK_SUFFIX + anchor;
    link.textContent = title;
    if (description) { listItem.appendChild(document.createElement("span")).textContent = " (" + description + ")"; }
    const excerpt = listItem.appendChild(document.createElement("p"));
    excerpt.className = "context";
    excerpt.textContent = createExcerpt(item, words);
    words.forEach((word) => _highlightText(listItem, word, "highlighted"));
    return listItem;
  }

  Search.query = function (query) {
    const words = query.toLowerCase().trim().split(/\s+/);
    const results = rankResults(Search._performSearch(...Search._parseQuery(query)), words);
    localStorage.setItem("sphinx_highlight_terms", words.join(" "));  // on the page that a result leads to
    Search.output.append(...results.map((item) => createListItem(item, words)));
    _finishSearch(results.length);
  };
})();
