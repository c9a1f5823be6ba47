"""What the site does beyond MkDocs: equations without a script, notebooks as pages, links to files that are no pages.

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

from uavnav import playground
from uavnav.choices import ConfigError
from uavnav.runs import POLICY
from uavnav.runs.tables import RunError

log = logging.getLogger("mkdocs.hooks.uavnav")

EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
PRIME = re.compile(r"<msup>(<mi>\w</mi>)<mi>&#x02032;</mi></msup>")
PRIME_AND_INDEX = re.compile(r"<msubsup>(<mi>\w</mi>)(<mi>\w</mi>)<mi>&#x02032;</mi></msubsup>")
PRIMED = r'<mrow>\1<mo form="postfix" lspace="0" rspace="0">&#x02032;</mo></mrow>'
"""A prime at the size of a superscript would be a dot."""
GENERATED = "results/"
"""What `make study` and `make report` write is not there before them."""
LINK = re.compile(r"(?<!!)\[([^\]\n]+)\]\((\.\./[^)#\s]+)(?:#[^)\s]+)?\)")


FLY, FLIES = "fly.html", "<!-- fly -->"
"""The playground's page on the site, and where a page says so."""


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Beside each notebook a page of its words and its code, without outputs; the playground of the study's runs."""
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        name = notebook.src_uri.removesuffix(".ipynb")
        files.append(File.generated(config, f"{name}.md", content=page_of(Path(notebook.abs_src_path))))
    if live := flown(Path(config.config_file_path).parent / GENERATED):
        files.append(File.generated(config, FLY, content=live))
    return files


def flown(folder: Path) -> str:
    """The playground of a folder's runs; nothing where there are none."""
    try:
        return playground.page(playground.collect([folder])[0])
    except (ConfigError, RunError):
        return ""


def page_of(notebook: Path) -> str:
    """A notebook's cells as Markdown."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    texts = [("".join(cell["source"]), cell["cell_type"]) for cell in cells]
    words = [f"```python\n{text}\n```" if kind == "code" else text for text, kind in texts]
    return "\n\n".join([*words, f"To run it: `docs/notebooks/{notebook.name}`, with Jupyter.", ""])


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Links to notebooks lead to their pages, others out of docs/ become paths; a file that is missing is a warning."""
    markdown = markdown.replace(".ipynb)", ".md)")
    root = Path(config.config_file_path).parent
    if FLIES in markdown and any((root / GENERATED).glob(f"*/*/{POLICY}")):
        markdown = markdown.replace(FLIES, f" [Fly it here]({FLY}).")

    def path_of(link: re.Match[str]) -> str:
        text, target = link.groups()
        path = os.path.relpath(root / "docs" / Path(page.file.src_uri).parent / target, root)
        if path.startswith("docs/"):
            return link[0]
        if not (root / path).exists() and not path.startswith(GENERATED):
            log.warning("%s links to %s, which is not in the repository", page.file.src_uri, path)
        if path.endswith(".csv") or path in text or f"{path}/" in text:  # a number of a table stands for itself
            return text
        return f"{text} (`{path}`)"

    return LINK.sub(path_of, markdown)


def on_page_content(html_of_page: str, **_: Any) -> str:
    """TeX that arithmatex has marked becomes MathML, which browsers show by themselves."""

    def mathml(found: re.Match[str]) -> str:
        tex = html.unescape(found[2]).strip()
        block = found[1] == "div"
        written = convert(tex, display="block" if block else "inline")
        written = PRIME_AND_INDEX.sub(rf"<msub>{PRIMED}\2</msub>", PRIME.sub(PRIMED, written))
        return f'<div class="equation">{written}</div>' if block else written

    return EQUATION.sub(mathml, html_of_page)
