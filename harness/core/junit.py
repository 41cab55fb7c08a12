"""Write test cases as JUnit XML, which CI systems show."""

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement, tostring

from harness.core.errors import printable

WHOLE = 10**6  # most characters of a message


@dataclass(frozen=True)
class Case:
    """One test case of a class `of`; `failure` says why it failed, and is None if it passed."""

    of: str
    name: str
    failure: str | None


def junit(name: str, cases: Sequence[Case]) -> str:
    """Return a test suite as XML; texts may hold any characters."""
    failed = sum(case.failure is not None for case in cases)
    suite = Element("testsuite", {"name": name, "tests": str(len(cases)), "failures": str(failed)})
    for case in cases:
        element = SubElement(suite, "testcase", classname=printable(case.of), name=printable(case.name))
        if case.failure is not None:
            SubElement(element, "failure", message=printable(case.failure, WHOLE))
    return tostring(suite, encoding="unicode", xml_declaration=True) + "\n"
