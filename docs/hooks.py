"""What the site shows of the rest of the repository: notebooks, records, pictures, SECURITY.md.

Nothing is copied into docs/ and nothing is executed: notebooks are shown as they are stored, and
figures on a page are those that `benchmarks/results.md` records, so neither can go stale alone.
"""

import base64
import html
import json
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

TOP = Path(__file__).parents[1]
RESULTS = TOP / "benchmarks" / "results.md"

# `<!-- results: SECTION -->`, or `<!-- results: SECTION | CAPTION -->` for one of its tables.
_RECORD = re.compile(r"<!-- results: ([\w-]+)(?: \| (.+?))? -->")

# What arithmatex makes of $...$ and $$...$$.
_FORMULA = re.compile(
    r'<(span|div) class="arithmatex">(?:\\\((.*?)\\\)|\\\[(.*?)\\\])</\1>', re.DOTALL
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what lies elsewhere in the repository to the pages of docs/."""

    def add(path: str, content: str | bytes) -> None:
        files.append(File.generated(config, path, content=content))

    for notebook in sorted((TOP / "notebooks").glob("*.ipynb")):
        page, pictures = notebook_page(notebook)
        add(f"notebooks/{notebook.stem}.md", page)
        for name, picture in pictures.items():
            add(f"notebooks/{name}", picture)
    add("notebooks/README.md", as_page(TOP / "notebooks" / "README.md"))
    add("benchmarks/results.md", as_page(RESULTS))
    add("security.md", as_page(TOP / ".github" / "SECURITY.md"))
    for picture in sorted((TOP / "benchmarks" / "figures").glob("*.*")):
        if picture.suffix in (".png", ".webp"):  # the second moves
            add(f"benchmarks/figures/{picture.name}", picture.read_bytes())
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put records in the place of their names."""
    del page, config, files
    return _RECORD.sub(lambda match: record(match[1], match[2]), markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Make MathML of formulas: browsers draw it without a script."""
    del page, config, files
    return _FORMULA.sub(lambda match: _mathml(match[2] or match[3], match[3] is not None), content)


def _mathml(formula: str, block: bool) -> str:
    display = "block" if block else "inline"
    return convert(html.unescape(formula.strip()), display=display)


def record(section: str, caption: str | None = None, results: str | None = None) -> str:
    """A section of `benchmarks/results.md` without its heading, or the one table of a caption.

    Args:
        section: the name in the section's markers.
        caption: how the table's caption begins; None: all of the section.
        results: the file's text; read if None.

    Raises:
        ValueError: there is no such section, or not exactly one such table.
    """
    text = RESULTS.read_text(encoding="utf-8") if results is None else results
    marked = rf"<!-- {section}:start -->\n## [^\n]*\n(.*?)<!-- {section}:end -->"
    found = re.search(marked, text, re.DOTALL)
    if found is None:
        raise ValueError(f"results.md has no section {section!r}.")
    if caption is None:
        return found[1].strip()
    tables = re.findall(rf"^\*\*{re.escape(caption)}[^\n]*\*\*\n\n(?:\|[^\n]*\n)+", found[1], re.M)
    if len(tables) != 1:
        raise ValueError(f"section {section!r} must have one table {caption!r}: got {len(tables)}.")
    return tables[0].strip()


def as_page(file: Path) -> str:
    """A page of the repository, its links to notebooks made links to pages."""
    return _linked(file.read_text(encoding="utf-8"))


def notebook_page(notebook: Path) -> tuple[str, dict[str, bytes]]:
    """A stored notebook as Markdown, and its pictures by name.

    A picture is named after its notebook and the id of its cell, so that other pages can show it.
    """
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(_linked(source))
            continue
        parts.append(f"```python\n{source}\n```")
        name = f"{notebook.stem}_{cell['id']}"
        parts.extend(_outputs(cell["outputs"], name, pictures))
    source = f"[`notebooks/{notebook.name}`](README.md)"
    parts.append(f"*This page is {source} as it was last executed.*")
    return "\n\n".join(parts) + "\n", pictures


def _outputs(outputs: list[dict], name: str, pictures: dict[str, bytes]) -> list[str]:
    parts = []
    for output in outputs:
        data = output.get("data", {})
        kind = next((k for k in ("image/jpeg", "image/png") if k in data), None)
        if kind:
            file = f"{name}.{kind.removeprefix('image/')}"
            pictures[file] = base64.b64decode("".join(data[kind]))
            parts.append(f"![what the cell above shows]({file})")
        elif "text/markdown" in data:
            parts.append("".join(data["text/markdown"]))
        else:
            text = "".join(output.get("text") or data.get("text/plain", ""))
            parts.append(f"```{{.text .output}}\n{text.rstrip()}\n```")
    return parts


def _linked(text: str) -> str:
    return re.sub(r"\]\(([^):]+)\.ipynb\)", r"](\1.md)", text)
