"""Whether the numbers of a text stand in the rows of tables that it links to, and how long its sentences
are.
"""

import csv
import re

NUMBER = re.compile(r"(?<![\w.,#])−?\d[\d,]*(?:\.\d+)?(?:e[−-]?\d+)?")
LINK = re.compile(r"\[([^\[\]]+)\]\(([^()\s]*?)tables/(\w+)\.csv(?:#L(\d+))?\)")
FACTORS = (1, 100, 1000)
"""Shares are shown in %, and rewards per frame in 1,000 frames."""
OF_WORDS = {"95", "100", "1,000", "14"}
"""Numbers that are words: 95 % intervals, in 100 steps, in 1,000 frames, eq. (14)."""
MOST_WORDS = 25
WORDS = {"1", "5", "6", "8", "10", "12", "16", "20", "26", "40", "46", "48", "160", "200", "0.001", "0.03"}
WORDS |= {"2,000", "10,000", "100,000", "300,000", "500,000", "600,000"}
"""Numbers of settings, and of how many there are, which no row holds."""


def value_and_unit(shown):
    """A shown number's size, and that of its last place; whole thousands may be rounded to them."""
    digits = shown.lstrip("−").replace(",", "").replace("−", "-")
    places = len(digits.partition("e")[0].partition(".")[2])
    return abs(float(digits)), 1000 if digits.endswith("000") else 10.0**-places * (
        float("1e" + digits.partition("e")[2]) if "e" in digits else 1
    )


def numbers_of(row):
    """The sizes of a row's cells that are numbers, and the numbers in its words."""
    sizes, words = [], set()
    for cell in row:
        try:
            sizes.append(abs(float(cell)))
        except ValueError:
            words |= {*NUMBER.findall(cell.replace("=", " "))}
    return sizes, words


def rows_linked(text, results):
    """The rows that a text links to; results: the folder of the tables."""
    for _, _, table, line in LINK.findall(text):
        with (results / "tables" / f"{table}.csv").open(newline="") as file:
            rows = list(csv.reader(file))
        yield from [rows[int(line) - 1]] if line else rows[1:]


def untied(text, results, known=()):
    """The numbers of a text that are in no row that it links to; known: those that need none."""
    sizes, words = [], OF_WORDS | {*known}
    for row in rows_linked(text, results):
        found = numbers_of(row)
        sizes += found[0]
        words |= found[1]
    shown = [number for number in NUMBER.findall(LINK.sub(r"\1", text)) if number not in words]
    return [number for number in shown if not any(fits(number, size) for size in sizes)]


def fits(shown, size):
    value, unit = value_and_unit(shown)
    return any(abs(factor * size - value) <= 0.5 * unit + 1e-5 * value for factor in FACTORS)


def sentences(text):
    """The sentences of Markdown: of each line, or each cell of a table, without links' targets."""
    plain = re.sub(r"\]\([^)\s]*\)", "]", text)
    parts = [
        part for line in plain.splitlines() for part in (line.split(" | ") if line[:1] == "|" else [line])
    ]
    return [one for part in parts for one in re.split(r"(?<=[.?!:]) +(?=[A-Z])", part) if words(one)]


def words(sentence):
    return [word for word in sentence.split() if re.search(r"\w", word)]


def too_long(text):
    return [one for one in sentences(text) if len(words(one)) > MOST_WORDS]


def first_screen(page):
    """What the report's page shows above its navigation and of its verdicts before anything is opened: a
    text each.
    """
    header = page.split("<header>")[1].split("</header>")[0]
    verdicts = page.split('<section id="verdicts">')[1].split("</section>")[0]
    closed = re.sub(r"(?s)</summary>.*?</details>", "</summary>", verdicts)
    parts = re.split(r"</?(?:p|li|h1|h2|span|summary|th|td|caption)\b[^>]*>", header + closed)
    return [text for part in parts if words(text := re.sub(r"<[^>]+>", "", part).strip())]
