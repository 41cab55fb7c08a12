"""A page as a browser reads it."""

import base64
import gzip
import json
import re
from collections import Counter
from html.parser import HTMLParser

from harness.report.page import write_report


class Page(HTMLParser):
    """What a browser would make of a page: elements, attributes, text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.pieces, self.styles = Counter(), [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags[tag] += 1
        self.attributes += [(tag, name, value or "") for name, value in attributes]

    def handle_data(self, data):
        self.pieces.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.pieces).split())

    def values(self, name):
        return [value for _, n, value in self.attributes if n == name]


def packed(text, name):
    """What lies compressed in a page under this id."""
    found = re.search(
        rf'<script type="application/gzip" id="{name}">([A-Za-z0-9+/=]+)</script>', text
    )
    return gzip.decompress(base64.b64decode(found[1])).decode()


def details(text):
    """Every decision that a page can open, by scene."""
    index = json.loads(packed(text, "index"))
    count = -(-len(index["scenes"]) // index["block"])
    every = [detail for n in range(count) for detail in json.loads(packed(text, f"block-{n}"))]
    return dict(zip((scene for scene, *_ in index["scenes"]), every, strict=True))


def unpacked(decisions):
    """The details of every decision of a report, before they are packed."""
    return [
        d for part in decisions.parts() for block in part.details.blocks(part.ids) for d in block
    ]


def by_workers(runs, base, monkeypatch, counts=(1, 2)):
    """The page of some runs as one process writes it, and as two do, in parts of a few scenes."""
    for name, scenes in (
        ("details.BLOCK", 2),
        ("decisions.BLOCK", 2),
        ("decisions.AT_ONCE", 4),
        ("page.PARTS_SHARED", 2),
    ):
        monkeypatch.setattr(f"harness.report.{name}", scenes)
    return [
        write_report(runs, base / f"{workers}.html", workers=workers).read_text()
        for workers in counts
    ]
