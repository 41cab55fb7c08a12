"""Templates of strangers: none runs for ever or fills memory,
and what they may do is as in Jinja.
"""

import resource
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread

import pytest
from hostile_templates import PADDING, TEMPLATES
from jinja2.sandbox import ImmutableSandboxedEnvironment

from harness.backends.chat_template import ChatTemplate
from harness.core.errors import UserError
from harness.core.templates import MOST_STEPS, Sandbox, TooMuch, begin, read, spend
from harness.prompts.template import Template

GROWTH_BYTES = 1 << 30
PATIENCE_S = 20.0  # CPU of this thread; the slowest takes some 2 s
PLAIN = ImmutableSandboxedEnvironment()
# These take long to compile; others are as deep, or as long.
DEAR = {"deep filters": "exhaustive", "deep loops": "slow", "many copies": "exhaustive"}
HOSTILE = [
    pytest.param(text, id=name, marks=getattr(pytest.mark, DEAR[name]) if name in DEAR else ())
    for name, text in (TEMPLATES | PADDING).items()
]


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A tenth of the steps, little memory, and an end.
    With all steps: benchmarks/campaigns/templates.py.
    """
    monkeypatch.setattr("harness.core.templates.MOST_STEPS", MOST_STEPS // 10)
    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + GROWTH_BYTES, limits[1]))
    begun_s = time.thread_time()
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.thread_time() - begun_s < PATIENCE_S


@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize("text", HOSTILE)
def test_no_prompt_template_runs_for_ever_or_fills_memory(text: str) -> None:
    with pytest.raises(Exception, match=r".") as refused:
        Template(f"{{% block user %}}{text}{{% endblock %}}").render({"actions": ("A",)}, ("user",))
    assert not isinstance(refused.value, MemoryError)


@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize("text", HOSTILE)
def test_no_chat_template_runs_for_ever_or_fills_memory(text: str) -> None:
    with pytest.raises(UserError, match=r"^model 'sly': its chat template ") as refused:
        ChatTemplate("sly", text).render([{"role": "user", "content": "x"}])
    assert str(refused.value).isprintable()


def test_the_limit_is_named_with_the_template() -> None:
    with pytest.raises(
        UserError, match=r"'sly': its chat template takes more than 1,000,000 steps"
    ):
        ChatTemplate("sly", TEMPLATES["loops"]).render([])
    with pytest.raises(UserError, match=r"no Jinja .it has 300,000 characters; allowed: 200,000"):
        ChatTemplate("sly", TEMPLATES["a long template"])


@pytest.mark.slow
def test_each_rendering_has_all_the_steps() -> None:
    template = Sandbox().from_string("{% for i in range(90000) %}{% endfor %}")
    for _ in range(30):
        assert template.render() == ""


def test_threads_do_not_pay_for_each_other() -> None:
    begin()
    spend(MOST_STEPS)
    other: list[bool] = []
    thread = Thread(target=lambda: other.append(spend(1)))
    thread.start()
    thread.join()
    assert other == [True]
    with pytest.raises(TooMuch):
        spend(1)


@pytest.mark.parametrize(
    ("value", "steps"),
    [(0.5, 0), (None, 0), ("short", 0), ("x" * 800, 101), ([1, 2], 5), ({"a": "x" * 80}, 14), (2**640, 11),
     ([["x" * 80] * 2] * 3, 3 * 2 * 11 + 3 * 3 + 4)],
)  # fmt: skip
def test_what_is_read_is_paid_by_its_size(value: object, steps: int) -> None:
    begin()
    read(value)
    spend(MOST_STEPS - steps)
    with pytest.raises(TooMuch):
        spend(1)


VALUES = {
    "text": "Some <b>text</b>\nof two lines", "n": 7, "x": 2.5, "none": None,
    "items": [{"role": "user", "content": "b", "k": 2}, {"role": "system", "content": "a", "k": 1}],
    "table": {"b": 1, "a": 2}, "words": ["b", "a", "b"],
}  # fmt: skip
ALIKE = [
    "{{ text | upper | replace('\n', ' ') | truncate(9, true, '…') }}{{ text | title | "
    "wordwrap(9) | indent(2) }}",
    "{{ words | join(', ') }}{{ items | join('-', attribute='content') }}{{ 'x' | join('y') }}{{ "
    "', '.join(words) }}",
    "{{ items | sum(attribute='k') }}{{ [[1], [2]] | sum(start=[]) }}{{ [1.5, 2] | sum }}",
    "{{ items | map(attribute='role') | list }}{{ items | selectattr('k', 'gt', 1) | "
    "map(attribute='role') | first }}",
    "{{ words | unique | sort | list }}{{ items | groupby('role') | list | length }}{{ table | "
    "dictsort }}",
    "{{ [1, 2, 3] | batch(2, 0) | list }}{{ [1, 2, 3] | slice(2) | list }}{{ x | round(1, 'ceil') "
    "}}{{ 'x' | center(9) }}",
    "{{ table | tojson }}{{ table | tojson(indent=2) }}{{ text | e }}{{ text | striptags }}{{ "
    "table | xmlattr }}",
    "{{ '%s of %05.1f' | format(n, x) }}{{ '%(a)s' % table }}{{ '{0:>4}{a}'.format(n, a=1) }}{{ "
    "'a' * 3 }}{{ [1] * 2 }}",
    "{{ n ** 2 % 5 // 2 - 1 + x / 2 }}{{ -n }}{{ n ~ x ~ none ~ [1] }}{{ 'a' + 'b' }}{{ [1] + [2] "
    "}}{{ 2 ** -1 }}",
    "{{ 'b' in words, 'x' not in text, 'a' in table, n == 7, 1 < n < 9, [1] == [1], n in [7] }}",
    "{{ text[5:8] }}{{ words[::-1] }}{{ table['a'] }}{{ items[0]['role'] }}{{ words[-1] }}{{ {n: "
    "1, 'a': x} }}",
    "{{ text.split('\n') }}{{ text.replace('b', 'c', 1) }}{{ 'a'.ljust(3) }}{{ '7'.zfill(3) }}{{ "
    "text.startswith('S') }}",
    "{% set ns = namespace(n=0) %}{% for i in items if i.k > 1 %}{% set ns.n = ns.n + i.k %}{% "
    "else %}x{% endfor %}{{ ns.n }}",
    "{% for a in [[1], 3] recursive %}{{ loop.depth }}{{ loop(a) if a is sequence else a }}{% "
    "endfor %}",
    "{% macro m(a, b='z') %}({{ a }}{{ b }}{{ caller() if caller }}){% endmacro %}{{ m(1) }}{% "
    "call m(2, b=3) %}!{% endcall %}",
    "{% set c = cycler('a', 'b') %}{{ c.next() }}{{ c.next() }}{% set j = joiner(', ') %}{{ j() "
    "}}{{ j() }}{% set s %}{{ n }}{% endset %}{{ s }}",
    "{% filter upper %}a{{ n }}{% endfilter %}{% with q = n %}{{ q }}{% endwith %}{% block inner "
    "%}{{ n }}{% endblock %}{{ self.inner() }}",
    "{% autoescape true %}{{ text }}{{ '<' ~ text }}{{ text | replace('o', '<') }}{{ words | "
    "join('<') }}{% endautoescape %}",
    "{{ nothing | default('d') }}{{ nothing is defined }}{{ nothing }}{{ n is odd }}{{ 'A' is "
    "upper }}{{ n is eq 7 }}{{ n is in [7] }}",
    "{{ range(3) | list }}{{ range(2, 8, 3) | max }}{{ dict(a=1) }}{{ [3, 1] | min }}{{ 'x' if n "
    "> 9 }}{{ words | random in words }}",
]  # fmt: skip


@pytest.mark.parametrize("text", ALIKE)
def test_what_a_template_may_do_is_as_in_jinja(text: str) -> None:
    assert Sandbox().from_string(text).render(VALUES) == PLAIN.from_string(text).render(VALUES)


ESCAPES = [
    "{{ ''.__class__.__mro__ }}", "{{ x.__init__ }}", 
        "{{ x | attr('__class__') }}", "{{ x['__class__'] }}",
    "{{ '{0.__class__}'.format(x) }}", "{{ (x | map(attribute='__class__') | list) }}",
    "{{ [x] | "
    "map(attribute='__class__') "
    "| list }}", "{{ lipsum.__globals__ }}", "{{ cycler.__init__.__globals__ }}",
    "{{ self._TemplateReference__context }}", "{{ namespace.__init__.__globals__ }}", "{{ [].append(1) }}",
    "{% set ns = namespace() %}{{ ns.__attrs }}{{ ns._Namespace__attrs }}",
    "{{ environment }}", "{{ spend }}{{ read }}{{ made }}", "{{ spend(-1) }}", "{{ x | spent }}",
]  # fmt: skip


@pytest.mark.parametrize("text", ESCAPES)
def test_what_reaches_out_is_refused_or_nothing(text: str) -> None:
    try:
        rendered = Sandbox().from_string(text).render(x="a")
    except Exception:
        return
    assert not any(word in rendered for word in ("class", "function", "module", "object at"))


def test_the_code_behind_a_template_has_names_that_it_cannot_write(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names: list[Callable[..., object]] = []
    monkeypatch.setattr("harness.core.templates.read", lambda value: names.append(value) or value)
    assert Sandbox().from_string("{{ read }}{{ x ~ x }}").render(x="a", read="b") == "baa"
