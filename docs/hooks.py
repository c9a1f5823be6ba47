"""What the site does beyond MkDocs: equations without a script, notebooks as pages, links to files that are
no pages.

The pages stay plain Markdown, which a forge shows too.
"""

from __future__ import annotations

import html
import json
import logging
import os
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

from uavnav.errors import ConfigError
from uavnav.runs import POLICY
from uavnav.runs.tables import RunError
from uavnav.views import browser
from uavnav.views.browser import playground

log = logging.getLogger("mkdocs.hooks.uavnav")

EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
PRIME = re.compile(r"<msup>(<mi>\w</mi>)<mi>&#x02032;</mi></msup>")
PRIME_AND_INDEX = re.compile(r"<msubsup>(<mi>\w</mi>)(<mi>\w</mi>)<mi>&#x02032;</mi></msubsup>")
PRIMED = r'<mrow>\1<mo form="postfix" lspace="0" rspace="0">&#x02032;</mo></mrow>'
"""A prime at the size of a superscript would be a dot."""
GENERATED = "results/"
"""What `make study` and `make report` write is not there before them."""
LINK = re.compile(r"(?<!!)\[([^][]+)\]\((\.\./[^)#\s]+)(?:#[^)\s]+)?\)")


REPORT = "report/"
"""Where the report is on the site."""
SHOWN = re.compile(r"<!-- (first|together) -->")
"""Where a page shows the report's first screen, and its episodes side by side."""
PARTS = ("report.html", "preview.png", "figures/*.png", "tables/*.csv")
"""What the site contains of a folder of results."""
LIMITATIONS = "../docs/limitations.md", "../limitations.html"
"""A link of the report, and what it is on the site."""
OF_REPORT = re.compile(r"\]\(\.\./results/(report\.html(?:#[\w-]+)?|figures/[\w-]+\.png)\)")
ROW = re.compile(r"\]\(\.\./results/tables/(\w+)\.csv(?:#L(\d+))?\)")
"""A number that stands in a table: a row of the report's page, where it has that row."""
OF_PANDAS = re.compile(r"<style.*?</style>|(?<=<table)[^>]*", re.DOTALL)
"""The looks that pandas gives a table, which has those of the page."""
FLY, FLIES = "fly.html", "<!-- fly -->"
"""The playground's page on the site, and where a page says so."""


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Add a page of its words, code and outputs for each notebook, and the playground of the
    study's runs.
    """
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        name = notebook.src_uri.removesuffix(".ipynb")
        files.append(File.generated(config, f"{name}.md", content=page_of(Path(notebook.abs_src_path))))
    root = Path(config.config_file_path).parent / GENERATED
    for path in sorted(path for pattern in PARTS for path in root.glob(pattern)):
        where = REPORT + path.relative_to(root).as_posix()
        if path.suffix == ".html":
            page = path.read_text(encoding="utf-8").replace(*LIMITATIONS)
            files.append(File.generated(config, where, content=page))
        else:
            files.append(File.generated(config, where, abs_src_path=str(path)))
    if live := playground_of(Path(config.config_file_path).parent / GENERATED / "vectorised"):
        files.append(File.generated(config, FLY, content=live))
    return files


def playground_of(folder: Path) -> str:
    """The playground of a folder's runs; nothing where there are none."""
    try:
        return playground.page(playground.collect([folder]))
    except (ConfigError, RunError):
        return ""


def page_of(notebook: Path) -> str:
    """A notebook's cells, and what they print and show, as Markdown."""
    parts = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
        parts += map(_shown, cell.get("outputs", []))
    return "\n\n".join([*parts, f"To run it: `docs/notebooks/{notebook.name}`, with Jupyter.", ""])


def _shown(output: dict[str, Any]) -> str:
    """An output of a cell: a picture within the page, a table, or text."""
    data = output.get("data", {"text/plain": output.get("text", "")})
    for kind in data:
        if kind.startswith("image/"):
            picture = "".join(data[kind]).replace("\n", "")
            return f"![What the cell above shows](data:{kind};base64,{picture})"
    if "text/html" in data:
        return OF_PANDAS.sub("", "".join(data["text/html"])).replace("\n", " ")
    return f"```text\n{''.join(data['text/plain']).strip(chr(10))}\n```"


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Links to notebooks lead to their pages, others out of docs/ become paths; a file that is missing is
    a warning.
    """
    root = Path(config.config_file_path).parent
    markdown = OF_REPORT.sub(rf"]({REPORT}\1)", markdown.replace(".ipynb)", ".md)"))
    if ROW.search(markdown) and (report := root / GENERATED / "report.html").exists():
        rows = {*re.findall(r'id="(row-\w+-\d*)"', report.read_text(encoding="utf-8"))}
        markdown = ROW.sub(lambda number: _row(number, rows), markdown)
    if FLIES in markdown and any((root / GENERATED).rglob(POLICY)):
        markdown = markdown.replace(FLIES, f" [Fly it here]({FLY}).")

    def path_of(link: re.Match[str]) -> str:
        text, target = link.groups()
        path = os.path.relpath(root / "docs" / Path(page.file.src_uri).parent / target, root)
        if path.startswith("docs/"):
            return link[0]
        if not (root / path).exists() and not path.startswith(GENERATED):
            log.warning("%s links to %s, which is not in the repository", page.file.src_uri, path)
        # a number of a table stands for itself
        if path.endswith(".csv") or path in text or f"{path}/" in text:
            return text
        return f"{text} (`{path}`)"

    return LINK.sub(path_of, markdown)


def _row(number: re.Match[str], rows: set[str]) -> str:
    name = f"row-{number[1]}-{number[2] or ''}"
    return f"]({REPORT}report.html#{name})" if name in rows else number[0]


def parts_of(report: Path, name: str) -> str:
    """The parts of a report's page with this mark, with their looks and scripts; nothing without a page."""
    if not report.exists():
        return ""
    page = report.read_text(encoding="utf-8")
    parts = "".join(re.findall(f"<!-- {name} -->(.*?)<!-- end of {name} -->", page, re.DOTALL))
    parts = parts.replace('href="#row-', f'href="{REPORT}report.html#row-')
    if name == "first":
        return f"<style>{browser.joined([browser.HERE / 'first.css'])}</style>{parts}"
    scripts = page.partition("</footer>")[2].partition('<script type="application/json" id="replay-data">')[0]
    return parts + scripts


def on_post_page(output: str, page: Any, config: Any) -> str:
    """A title, a sentence and a picture for those who are sent a link: an address where SITE_URL says
    which.
    """
    up = config.site_url or "../" * page.url.count("/")
    sentence = re.search(r'<div class="first">\s*<h1>(.*?)</h1>', output, re.DOTALL)
    said = re.sub(r"<[^>]+>", "", sentence[1]).strip() if sentence else config.site_description
    title = config.site_name if page.is_homepage else f"{page.title} - {config.site_name}"
    told = {"og:type": "website", "og:title": title, "og:description": said}
    told |= {"og:image": f"{up}{REPORT}preview.png", "twitter:card": "summary_large_image"}
    tags = (f'<meta property="{name}" content="{html.escape(words)}">' for name, words in told.items())
    # the theme names no dialog
    output = output.replace('role="dialog">', 'role="dialog" aria-label="Search">', 1)
    return output.replace("</head>", "".join([*tags, "</head>"]), 1)


def on_page_content(html_of_page: str, config: Any, **_: Any) -> str:
    """TeX that arithmatex has marked becomes MathML, which browsers show by themselves; the report's parts
    are put in.
    """
    report = Path(config.config_file_path).parent / GENERATED / "report.html"
    html_of_page = SHOWN.sub(lambda mark: parts_of(report, mark[1]), html_of_page)

    def mathml(found: re.Match[str]) -> str:
        tex = html.unescape(found[2]).strip()
        block = found[1] == "div"
        written = convert(tex, display="block" if block else "inline")
        written = PRIME_AND_INDEX.sub(rf"<msub>{PRIMED}\2</msub>", PRIME.sub(PRIMED, written))
        return f'<div class="equation">{written}</div>' if block else written

    return EQUATION.sub(mathml, html_of_page)
