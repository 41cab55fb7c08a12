"""The report as it is used: opened from disk, filtered, followed, sorted, saved and printed."""

import json
import re
import sys
from urllib.parse import parse_qsl

import numpy as np
import pytest

pytest.importorskip("playwright", reason="needs the dev extra")
pytest.importorskip("axe_playwright_python", reason="needs the dev extra")

from axe_playwright_python.sync_playwright import Axe
from evaluating import run as evaluate
from evaluating import spec_of
from opening import NARROW, SHEETS, WIDE, picture, sheets, wait
from playwright.sync_api import expect
from reading import packed

from harness import cli
from harness.report.page import write_report
from harness.report.runs import gather
from harness.runs.folder import read

SIZE = """async (shown) => {
  const image = new Image();
  image.src = shown.querySelector("image").getAttribute("href");
  await image.decode();
  return [image.width, image.height];
}"""
RUNS = (("proxy", "v1"), ("proxy", "v2"), ("proxy-faulty", "v2"), ("local-view", "v2"))
ONE = "proxy-v2"


def typed(*words):
    """The command as typed."""
    sys.argv = ["harness", *map(str, words)]
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code


@pytest.fixture(scope="module")
def report(small, tmp_path_factory):
    """Two models, two prompts and two more, under three conditions; of one the page alone, too."""
    base = tmp_path_factory.mktemp("browser")
    for model, prompt in RUNS:
        evaluate(spec_of(small, model, prompt, latency="paper"), base / f"{model}-{prompt}")
    write_report(gather([base / ONE]), base / ONE / "report.html")
    folders = [base / f"{model}-{prompt}" for model, prompt in RUNS]
    return write_report(gather(folders), base / "report.html", full=True)


@pytest.fixture(scope="module")
def index(report):
    return json.loads(packed(report.read_text(), "index"))


def count(page):
    return int(re.match(r"\d+", page.locator("#list > p[aria-live]").inner_text())[0])


def choose(page, name, value):
    page.locator(f"#list select[name={name}]").select_option(value)


@pytest.mark.slow
def test_it_opens_from_disk_with_every_chart_drawn(opened, report):
    page = opened(report)
    assert "SwarmDrive Harness" in page.title()
    charts = page.locator("[data-chart]")
    assert charts.count() >= 6
    for n in range(charts.count()):
        assert charts.nth(n).locator("svg").count() == 1, charts.nth(n).get_attribute("data-chart")
    assert page.get_by_text("cannot be drawn").count() == 0
    picture(page, "report-1440")


@pytest.mark.exhaustive
@pytest.mark.parametrize("size", [{"width": 1440, "height": 900}, NARROW], ids=["wide", "narrow"])
def test_what_is_read_first_stands_on_the_first_screen(opened, report, size):
    one = report.parent / ONE / "report.html"
    page = opened(one, size=size)
    above = 0
    for what in ("h1", ".headline", ".first > .key div:last-child"):
        box = page.locator(what).first.bounding_box()
        assert box["y"] > above, what
        above = box["y"]
    figure = page.locator("#chart-success-latency svg").bounding_box()
    assert figure["y"] + figure["height"] <= size["height"]
    limits = page.locator(".more .caveat")
    assert limits.first.bounding_box()["y"] > above, "how far numbers carry stands below them"
    assert page.locator(".first > .key > div").count() == 2
    assert page.locator(".key > div").count() == 7
    assert len(page.locator(".headline").inner_text()) < 280
    assert not page.locator("#metrics table").is_visible(), "all metrics are behind a fold"
    picture(page, f"report-first-{size['width']}")


@pytest.mark.exhaustive
def test_the_answer_that_lost_an_episode_is_two_clicks_away(opened, report, index):
    page = opened(report)
    page.get_by_role("link", name="Episodes", exact=True).click()
    losing = page.locator("#strips .cell.end-u").first
    told = losing.get_attribute("aria-label")
    assert told.endswith("the answer that lost this episode")
    losing.click()
    expect(page.locator("#decision h1")).to_contain_text("Decision")
    where = dict(parse_qsl(page.evaluate("location.hash.slice(1)")))
    said = (
        f"{where['condition']}: {told.split()[2].rstrip(',')} ✗ the answer that lost this episode"
    )
    expect(
        page.locator("#decision .verdict.bad").filter(has_text=where["condition"])
    ).to_contain_text(said)


@pytest.mark.exhaustive
def test_the_lost_episode_is_played_from_its_first_decision_on(opened, report):
    page = opened(report.parent / ONE / "report.html")
    film = page.locator("#replay")
    steps, now = film.locator(".strip .cell"), film.locator("[aria-current]")
    lost = now.get_attribute("aria-label")
    assert lost.endswith("the answer that lost this episode")
    said = film.locator("p").first.inner_text()
    step, action = re.search(r"lost at step (\d+) by (\w+)", said).groups()
    assert lost.startswith(f"step {step}: {action}")
    assert film.locator("svg.scene").is_visible()
    expect(film.locator(".pair strong")).to_have_text(f"Step {step}: {action}")
    page.clock.install()
    film.get_by_role("button", name="Play").click()
    for n in range(steps.count()):
        expect(now).to_have_attribute("aria-label", steps.nth(n).get_attribute("aria-label"))
        page.clock.run_for(1500)
    film.get_by_role("button", name="Play").wait_for()
    film.get_by_role("button", name="one decision back").click()
    label = steps.nth(steps.count() - 2).get_attribute("aria-label")
    expect(now).to_have_attribute("aria-label", label)


@pytest.mark.exhaustive
def test_episodes_are_sorted_by_what_they_cost(opened, report, index):
    page = opened(report, "#episodes")
    run, S = index["runs"][0], len(index["runs"][0]["seeds"])
    every = len(run["conditions"]) * S

    def cost(episode, condition):
        lost = set()
        for n, (_, of, *_) in enumerate(index["scenes"]):
            ends = run["ended"][n * every + condition * S : n * every + condition * S + S]
            lost |= {s for s in range(S) if of == episode and ends[s] == "u"}
        return len(lost)

    for by in ("", "single-local", "6g"):
        page.locator("#strips select").select_option(by)
        of = [k for k, name in enumerate(run["conditions"]) if by in ("", name)]
        rows = page.locator("#strips tbody th").all_inner_texts()
        costs = [sum(cost(int(episode), k) for k in of) for episode in rows]
        assert costs == sorted(costs, reverse=True)
        assert by or costs[0] > 0


@pytest.mark.exhaustive
def test_the_picture_follows_the_conflict_and_shades_what_is_hidden(opened, report, index):
    page = opened(report, f"#scene={index['scenes'][1][0]}", {"width": 1440, "height": 900})
    side = float(page.locator("svg.scene").get_attribute("viewBox").split()[2])
    assert 40 < side < 160
    assert page.locator("svg.scene .shadow polygon").count() > 0
    assert page.locator("svg.scene .scale").count() == 1
    assert page.locator("svg.scene .label.ego").inner_html().endswith(" m/s")
    box = page.locator(".pair .chart svg").bounding_box()
    assert box["y"] + box["height"] <= 900, "the distributions are on the first screen too"
    page.locator("select[name=zoom]").select_option("all")
    expect(page.locator("svg.scene")).to_have_attribute("viewBox", "-80 -80 160 160")


@pytest.mark.exhaustive
@pytest.mark.parametrize(("size", "beside"), [(WIDE, 4), (NARROW, 1)])
def test_the_cameras_pictures_have_boxes_that_can_be_switched_off(
    opened, report, index, size, beside
):
    page = opened(report, f"#scene={index['scenes'][1][0]}", size)
    frames, boxes = page.locator(".frame"), page.locator(".frame .label")
    assert frames.count() == 4
    assert len({round(frames.nth(n).bounding_box()["x"]) for n in range(4)}) == beside
    for shown in frames.all():
        assert shown.get_attribute("viewBox") == "0 0 {} {}".format(*shown.evaluate(SIZE))
        labels = shown.locator(".label").all_text_contents()
        assert set(
            re.findall(r"v\d+(?= [a-z])", shown.get_attribute("aria-label").split("Listed")[0])
        ) == set(labels)
    assert "The model was not shown these pictures" in page.locator(".cameras").inner_text()
    assert boxes.first.is_visible()
    page.get_by_label("boxes around what the sensors list").uncheck()
    assert not boxes.first.is_visible()
    page.get_by_role("link", name="next →").click()
    expect(page.locator("#decision h1")).to_contain_text(index["scenes"][2][0])
    assert not boxes.first.is_visible()
    page.emulate_media(media="print")
    assert frames.first.is_visible()
    assert not page.locator(".cameras label").is_visible()


@pytest.mark.exhaustive
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_on_a_phone_nothing_is_wider_than_the_phone(opened, report, index, scheme):
    page = opened(report, size=NARROW, scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]
    picture(page, f"report-390-{scheme}")
    run = index["runs"][0]
    # has the longest verdict
    lost = run["ended"].index("u") // (len(run["conditions"]) * len(run["seeds"]))
    page = opened(report, f"#scene={index['scenes'][lost][0]}", NARROW, scheme)
    assert page.locator("#decision .verdict.bad").is_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]
    picture(page, f"decision-390-{scheme}")


@pytest.mark.exhaustive
def test_what_a_rules_page_leaves_out_is_said_in_one_line(opened, report, index):
    page = opened(report.parent / ONE / "report.html", f"#scene={index['scenes'][1][0]}")
    assert page.get_by_text("Not in this page").inner_text() == (
        "Not in this page: the camera pictures; the prompts, which the model does not read. "
        "harness view shows them; harness report RUN --full writes a page that has them."
    )
    assert page.locator(".cameras, .answer details").count() == 0
    assert page.get_by_text("its text is not available").count() == 0
    picture(page, "decision-left-out")


@pytest.mark.exhaustive
def test_filters_leave_the_decisions_that_have_what_is_asked(opened, report, index):
    page = opened(report, "#decisions")
    run = index["runs"][0]
    every = len(run["conditions"]) * len(run["seeds"])
    reached = [
        any(
            run["acted"][n * every + c * len(run["seeds"])] != "-"
            for c in range(len(run["conditions"]))
        )
        for n in range(len(index["scenes"]))
    ]
    assert count(page) == sum(reached), "another run may come to other decision points"
    sectors = [
        danger for (*_, danger), there in zip(index["scenes"], reached, strict=True) if there
    ]
    for sector in set(sectors):
        choose(page, "danger", sector or "none")
        assert count(page) == sectors.count(sector)
    page.get_by_role("button", name="Clear").click()
    choose(page, "run", "2")
    masks = index["runs"][2]["statuses"]
    [*failed] = (
        k for k, s in enumerate(index["statuses"]) if k > 1 and any(mask >> k & 1 for mask in masks)
    )
    assert failed
    for k in failed:
        choose(page, "status", index["statuses"][k])
        assert count(page) == sum(mask >> k & 1 for mask in masks)
    page.get_by_role("button", name="Clear").click()
    wait(page)
    choose(page, "condition", "single-local")
    choose(page, "outcome", "u")
    assert count(page) == sum(run["ended"][n * every] == "u" for n in range(len(index["scenes"])))
    # The address has the filters: whoever is sent it sees the same list.
    again = opened(report, page.evaluate("location.hash"))
    assert count(again) == count(page)


@pytest.mark.exhaustive
def test_runs_that_disagree_are_found(opened, report, index):
    page = opened(report, "#decisions")
    choose(page, "differ", "runs")
    runs = index["runs"]
    every = len(runs[0]["conditions"]) * len(runs[0]["seeds"])
    places = [k * len(runs[0]["seeds"]) for k in range(len(runs[0]["conditions"]))]
    disagree = sum(
        any(
            runs[0]["acted"][n * every + place] != "-"
            and len({run["acted"][n * every + place] for run in runs} - {"-"}) > 1
            for place in places
        )
        for n in range(len(index["scenes"]))
    )
    assert 0 < count(page) == disagree


@pytest.mark.exhaustive
def test_answers_of_runs_stand_side_by_side_and_are_found_where_they_differ(opened, report, index):
    page = opened(report, "#decisions=&differ=answers")
    first, *others = index["runs"]
    every = len(first["conditions"]) * len(first["seeds"])
    differ = [
        n
        for n in range(len(index["scenes"]))
        if any(
            letter != "-"
            for letter in first["acted"][n * every : (n + 1) * every : len(first["seeds"])]
        )
        and len({run["said"][n] for run in (first, *others)} - {"-"}) > 1
    ]
    assert 0 < count(page) == len(differ)
    scene = index["scenes"][differ[0]][0]
    row = page.locator("#list tbody tr").first
    assert row.locator("th").inner_text() == scene
    page.wait_for_function("!document.querySelector('#list .own:not(:has(small))')")
    runs = [read(report.parent / f"{model}-{prompt}") for model, prompt in RUNS]
    answers = [a for run in runs for a in run.answers_by_scene.get(scene, ()) if a.role == "ego"]
    for own, answer in zip(row.locator(".own").all(), answers, strict=True):
        likeliest = (
            runs[0].actions[int(np.argmax(answer.intent))] if answer.intent else "not readable"
        )
        assert own.inner_text().startswith(likeliest)
        assert own.locator("small").inner_text().startswith(" ".join(answer.raw.split())[:40])


@pytest.mark.exhaustive
def test_a_text_is_searched_in_names_at_once_and_in_answers_on_enter(opened, report, index):
    page = opened(report, "#decisions")
    search = page.locator("input[name=q]")
    search.fill(index["scenes"][3][0])
    assert count(page) == 1
    search.fill("I am sorry, I cannot")
    assert count(page) == 0
    search.fill("```json")
    search.press("Enter")
    expect(page.locator("#list > p[aria-live]")).to_have_text(re.compile(r"^[1-9]\d* of"))
    found = count(page)
    assert 0 < found < len(index["scenes"])


@pytest.mark.slow
def test_a_decision_opens_by_its_link_and_keys_lead_on(opened, report, index):
    scene = index["scenes"][1][0]
    page = opened(report, f"#scene={scene}&run=1&condition=v2x&viewer=v2")
    assert scene in page.locator("#decision h1").inner_text()
    assert not page.locator("#report").is_visible()
    assert page.locator("svg.scene").get_attribute("aria-label").startswith("v2 (helper) sees")
    assert page.locator("#decision .chart svg").count() == 2
    page.locator(".answer details summary").first.click()
    assert page.get_by_text("CONFLICTS", exact=False).first.is_visible()
    picture(page, "decision-1440")
    page.keyboard.press("ArrowRight")
    expect(page.locator("#decision h1")).to_contain_text(index["scenes"][2][0])
    page.keyboard.press("Escape")
    page.wait_for_selector("#report", state="visible")
    page.go_back()
    page.wait_for_selector("#decision", state="visible")


@pytest.mark.exhaustive
def test_a_decision_opens_from_the_list_by_keyboard_alone(opened, report, index):
    page = opened(report, "#decisions")
    link = page.locator("#list a[data-n]").first
    link.focus()
    page.keyboard.press("Enter")
    page.wait_for_selector("#decision h1")
    assert page.evaluate("document.activeElement.tagName") == "H1"
    assert index["scenes"][0][0] in page.locator("#decision h1").inner_text()


@pytest.mark.exhaustive
def test_a_link_to_no_decision_says_so(opened, report):
    page = opened(report, "#scene=99999-9")
    assert "has no decision 99999-9" in page.locator("#decision").inner_text()


@pytest.mark.exhaustive
def test_what_was_read_in_a_recovered_answer_is_marked(opened, report, index):
    odd = index["statuses"].index("recovered")
    n = next(n for n, mask in enumerate(index["runs"][2]["statuses"]) if mask >> odd & 1)
    page = opened(report, f"#scene={index['scenes'][n][0]}&run=2")
    assert page.locator("mark").count() > 0
    assert page.locator("mark").first.inner_text().lstrip().startswith("{")


@pytest.mark.exhaustive
def test_the_matrix_is_sorted_by_a_click_on_a_head(opened, report):
    page = opened(report, "#matrix")
    table = page.locator("#matrix table.sortable")

    def column():
        cells = table.locator("tbody tr td:nth-child(6)")
        return [
            float(x) for x in cells.evaluate_all("cells => cells.map(cell => cell.dataset.value)")
        ]

    before = column()
    table.get_by_role("button", name=re.compile("^success")).click()
    assert column() == sorted(before, reverse=True)
    table.get_by_role("button", name=re.compile("^success")).click()
    assert column() == sorted(before)
    assert table.locator("th[aria-sort=ascending]").inner_text() == "success"


@pytest.mark.exhaustive
def test_a_table_is_copied_as_csv(opened, report):
    page = opened(report, "#matrix")
    page.evaluate("navigator.clipboard.writeText = async (text) => { window.copied = text; }")
    page.locator("#matrix .fold > div.scroll + button").click()
    lines = page.evaluate("window.copied").strip().split("\r\n")
    assert lines[0].startswith(
        '"run","condition","balanced success","with a danger","without","success"'
    )
    assert len(lines) == 1 + 4 * 3
    page.locator("#chart-replies button").click()
    assert page.evaluate("window.copied").startswith('"run","condition","reply","count"')


@pytest.mark.exhaustive
def test_figures_are_saved_as_svg_and_png(opened, report, index):
    page = opened(report)
    for kind, begins in (("SVG", b"<svg"), ("PNG", b"\x89PNG")):
        with page.expect_download() as saved:
            page.locator("#chart-success-latency").get_by_text(f"Save as {kind}").click()
        assert saved.value.suggested_filename == f"success-latency.{kind.lower()}"
        assert begins in saved.value.path().read_bytes()[:60]
    page = opened(report, f"#scene={index['scenes'][0][0]}")
    for kind, begins in (("SVG", b"<svg"), ("PNG", b"\x89PNG")):
        with page.expect_download() as saved:
            page.locator(".picture").get_by_text(f"Save as {kind}").click()
        assert saved.value.path().read_bytes().startswith(begins)


def paper(page):
    return page.evaluate("getComputedStyle(document.body).backgroundColor")


@pytest.mark.exhaustive
def test_dark_is_the_systems_choice_or_ones_own(opened, report):
    light, dark = opened(report), opened(report, scheme="dark")
    assert paper(light) == "rgb(255, 255, 255)" != paper(dark)
    light.get_by_role("button", name="Dark").click()
    assert paper(light) == paper(dark)
    picture(light, "report-1440-dark")
    light.get_by_role("button", name="Light").click()
    assert paper(light) == "rgb(255, 255, 255)"


@pytest.mark.exhaustive
def test_it_prints_light_and_without_controls(opened, report):
    page = opened(report, scheme="dark")
    page.emulate_media(media="print", color_scheme="dark")
    assert paper(page) == "rgb(255, 255, 255)"
    assert not page.locator("nav").is_visible()
    assert not page.locator("#list form").is_visible()
    assert page.locator("#probabilities th button").first.is_visible(), (
        "the heads of columns are on paper, too"
    )
    assert sheets(page) <= SHEETS
    page.emulate_media(media="screen")
    page.get_by_role("button", name="Unfold all").click()
    page.emulate_media(media="print", color_scheme="dark")
    assert sheets(page) > SHEETS, "who asks for all gets it"
    page.set_viewport_size({"width": 718, "height": 1040})  # A4 with margins of 10 mm
    assert page.evaluate("document.documentElement.scrollWidth") <= 718
    for table in ("#strips", "#probabilities"):
        heads = page.locator(f"{table} thead tr").first.bounding_box()
        assert heads["height"] < 60, "no head breaks within a word"


@pytest.mark.exhaustive
@pytest.mark.parametrize("where", ["", "#scene"])
def test_it_can_be_read_by_who_does_not_see_it(opened, report, index, where):
    page = opened(report, where and f"#scene={index['scenes'][0][0]}")
    found = Axe().run(page, options={"runOnly": ["wcag2a", "wcag2aa"]}).response["violations"]
    assert [(v["id"], [node["html"][:120] for node in v["nodes"]][:3]) for v in found] == []


@pytest.mark.exhaustive
def test_one_episode_under_one_condition_has_a_page_without_intervals(opened, small_path, tmp_path):
    run = tmp_path / "one"
    typed(
        "eval", "--model", "proxy", "--dataset", small_path, "--out", run, "--limit", "1", "--seeds", "0",
        "--condition", "single-local", "--quiet",
    )  # fmt: skip
    page = opened(run / "report.html")
    assert page.get_by_text("No reply was scheduled").count() == 1
    assert page.locator("#chart-success-latency svg").count() == 1
