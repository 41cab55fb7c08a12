import pytest


@pytest.fixture
def svg_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Studies draw no PDF and no PNG, which take longest: which kinds a folder has, a few tests look at."""
    monkeypatch.setattr("harness.report.drawing.pictures.FORMATS", ("svg",))
