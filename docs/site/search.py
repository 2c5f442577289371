"""For the built site: its search needs no server. What MkDocs brings asks a worker, which a browser refuses to a file.

The index lies in a script beside the page, which is loaded when somebody searches.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

END = "if (!window.Worker) {\n  console.log"
"""Where the part of ``main.js`` begins that starts the worker."""
TAIL = """
// no worker: the index is a script, which a page that is opened from a folder may load, too
var index = null, documents = {}, min_search_length = 0;

function search(query) {
  return index.search(query).map(function (found) {
    var page = documents[found.ref];
    return {location: page.location, title: page.title, summary: page.text.substring(0, 200)};
  });
}

var searchWorker = {postMessage: function (message) { displayResults(search(message.query)); }};

if (document.getElementById("mkdocs-search-query")) {
  var script = document.createElement("script");
  script.src = joinUrl(base_url, "search/index.js");
  script.onload = function () {
    min_search_length = searchData.config.min_search_length - 1;
    lunr.tokenizer.separator = new RegExp(searchData.config.separator);
    index = lunr(function () {
      this.field("title");
      this.field("text");
      this.ref("location");
      searchData.docs.forEach(function (page) {
        this.add(page);
        documents[page.location] = page;
      }, this);
    });
    initSearch();
  };
  document.head.appendChild(script);
}
"""


def on_post_build(config: Any, **_: Any) -> None:
    """Put the index into a script, and search in it.

    Raises:
        ValueError: If the search of this version of MkDocs is another one.
    """
    folder = Path(config["site_dir"]) / "search"
    main, lunr, data = (
        (folder / name).read_text("utf-8") for name in ("main.js", "lunr.js", "search_index.json")
    )
    if main.count(END) != 1:
        raise ValueError(
            "MkDocs' search/main.js has changed: docs/site/search.py does not find its worker's start"
        )
    (folder / "index.js").write_text(f"{lunr}\nvar searchData = {data};\n", "utf-8")
    (folder / "main.js").write_text(main[: main.index(END)] + TAIL, "utf-8")
    (folder / "worker.js").unlink()
