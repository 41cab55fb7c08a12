"""A page as a browser reads it."""

import base64
import gzip
import json
import re
from collections import Counter
from html.parser import HTMLParser


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
    found = re.search(rf'<script type="application/gzip" id="{name}">([A-Za-z0-9+/=]+)</script>', text)
    return gzip.decompress(base64.b64decode(found[1])).decode()


def details(text):
    """Every decision that a page can open, by scene."""
    index = json.loads(packed(text, "index"))
    count = -(-len(index["scenes"]) // index["block"])
    every = [detail for n in range(count) for detail in json.loads(packed(text, f"block-{n}"))]
    return dict(zip((scene for scene, *_ in index["scenes"]), every, strict=True))
