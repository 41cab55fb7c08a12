"""Write test cases as JUnit XML, which CI systems show."""

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement, tostring

from harness.core.errors import printable

WHOLE = 10**6  # most characters of a message


@dataclass(frozen=True)
class Case:
    """Describe one test case of a JUnit report.

    `of` is the class of tests it belongs to. `failure` says why it failed and `error` why it has no
    result; both are None if it passed. `said` is what else is said of it, as its output.
    """

    of: str  # the class
    name: str  # the case's own name
    failure: str | None = None  # why it failed; None if it passed
    error: str | None = None  # why it has no result; None if it has one
    said: str | None = None  # what else is said of it, as its output


def junit(name: str, cases: Sequence[Case]) -> str:
    """Return JUnit XML of a test suite `name`; characters that XML cannot hold are escaped."""
    failed = sum(case.failure is not None and case.error is None for case in cases)
    errors = sum(case.error is not None for case in cases)
    counts = {"tests": str(len(cases)), "failures": str(failed)}
    if errors:
        counts["errors"] = str(errors)
    suite = Element("testsuite", {"name": printable(name), **counts})
    for case in cases:
        element = SubElement(
            suite, "testcase", classname=printable(case.of), name=printable(case.name)
        )
        if case.error is not None:
            SubElement(element, "error", message=printable(case.error, WHOLE))
        elif case.failure is not None:
            SubElement(element, "failure", message=printable(case.failure, WHOLE))
        if case.said is not None:
            SubElement(element, "system-out").text = printable(case.said, WHOLE)
    return tostring(suite, encoding="unicode", xml_declaration=True) + "\n"
