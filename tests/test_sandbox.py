"""A template reads a scene's members, and nothing that the sandbox forbids."""

import math

import pytest
from jinja2 import Environment, StrictUndefined, UndefinedError
from jinja2.exceptions import SecurityError, TemplateAssertionError
from jinja2.sandbox import ImmutableSandboxedEnvironment

from harness.core import templates
from harness.prompts.sandbox import Sandbox
from harness.prompts.template import Template

SANDBOX = Sandbox(undefined=StrictUndefined)
PLAIN_SANDBOX = templates.Sandbox(undefined=StrictUndefined)


def rendered(template: str, **context: object) -> str:
    return SANDBOX.from_string(template).render(context)


def test_a_member_is_read_by_its_name_even_where_a_method_has_it_too():
    assert (
        rendered("{{ graph.items }}, {{ graph.ego.id }}", graph={"items": 3, "ego": {"id": "v1"}})
        == "3, v1"
    )


@pytest.mark.parametrize("name", ["first", "index", "index0", "last"])
def test_a_loop_says_of_itself_what_it_says_in_the_plain_sandbox(name):
    template = "{% for a in actions %}{{ loop." + name + " }} {% endfor %}"
    plain = ImmutableSandboxedEnvironment(undefined=StrictUndefined).from_string(template)
    assert rendered(template, actions="SIF") == plain.render(actions="SIF")


@pytest.mark.parametrize(
    "template",
    ["{{ graph.__class__ }}", "{{ graph.update({'ego': 1}) }}", "{{ ''.__class__.__mro__ }}",
     "{% for a in 'SIF' %}{{ loop.__init__.__globals__ }}{% endfor %}"],
)  # fmt: skip
def test_what_is_no_member_is_still_kept_from_a_template(template):
    with pytest.raises(SecurityError):
        rendered(template, graph={"ego": {}})


def test_a_member_that_is_not_there_is_an_error():
    with pytest.raises(UndefinedError):
        rendered("{{ graph.egg }}", graph={"ego": {}})


@pytest.mark.parametrize(
    "template",
    ["{{ 'a'.ljust(3000000000) }}", "{{ 'a' * 10000000000 }}", "{{ [1] * 10000000000 }}",
     "{{ 10 ** 10000000 }}",
     "{{ '%3000000000d' | format(1) }}", 
         "{{ '%*d' | format(3000000000, 1) }}", "{{ '%3000000000d' % 1 }}",
     "{{ '{:3000000000}'.format(1) }}"],
)  # fmt: skip
def test_no_template_fills_memory(template):
    with pytest.raises(SecurityError):
        rendered(template)


@pytest.mark.parametrize(
    "template", ["{{ 'a' | center(3000000000) }}", "{{ 'a' | indent(3000000000) }}"]
)
def test_filters_that_pad_are_gone(template):
    with pytest.raises(TemplateAssertionError):
        rendered(template)


def test_numbers_are_multiplied_and_formatted():
    assert (
        rendered("{{ (0.25 * 100) | round | int }} {{ '%.2f' | format(0.5) }} {{ 7 % 4 }}")
        == "25 0.50 3"
    )


ALIKE = [
    "100 % of {{ n }}%{{ n }}%s",
    "{% for a in names %}{{ loop.index }}/{{ loop.index0 }}{{ a }}{{ ', ' if not loop.last }}{% "
    "endfor %}",
    "{% for a in 'SIF' %}{{ loop.first }}{{ loop.last }}{% else %}none{% endfor %}",
    "{% for a in range(40) | list %}{{ loop.index }}{{ ';' if not loop.last }}{% endfor %}",
    "{% for a in [] %}{{ loop.last }}{% else %}none{% endfor %}",
    "{% for a in names %}{{ loop.cycle('x', 'y') }}{{ loop.length }}{{ loop.revindex }}{% endfor "
    "%}",
    "{% for a in names %}{% for b in 'xy' %}{{ a }}{{ loop.last }}{% endfor %}{{ loop.last }}{% "
    "endfor %}",
    "{% for a in [[1], 3] recursive %}{{ loop.depth }}{{ loop(a) if a is sequence else a }}{% "
    "endfor %}",
    "{% for a in names if a != 'b' %}{{ a }}{{ loop.last }}{% endfor %}",
    "{% for a, b in graph.items() %}{{ a }}{{ b }}{{ loop.first }}{% endfor %}",
    "{% for a in names %}{% set outer = loop %}{{ outer.last }}{% endfor %}",
    "{{ 2.5 | round | int }} {{ 3.5 | round | int }} {{ -0.4 | round | int }} {{ 7 | round | int "
    "}}",
    "{{ big | round | int }} {{ nan | round | int }} {{ true | round | int }} {{ n | round(1) | "
    "int }}",
    "{{ n * 100 }} {{ 3 * 2.5 }} {{ n * n }} {{ true * 2 }} {{ (n * 100) | round | int }}",
    "{{ n is none }} {{ none is none }} {{ 'x' if n is not none else '?' }} {{ nothing is none }}",
    "{% autoescape true %}<{{ '<' }}>{{ graph.ego.id }}{% endautoescape %}{{ '<' }}",
    "{% set x %}[{{ n }}]{% endset %}{{ x }}{% macro m(a) %}({{ a.id }}){% endmacro %}{{ "
    "m(graph.ego) }}",
    "{% filter upper %}a{{ graph.ego.id }}{% endfilter %}{% block inner %}{{ graph.ego.id }}%{% "
    "endblock %}",
    "{{ graph.ego }} {{ graph['ego'].id }} {{ graph.ego.id.upper() }} {{ names.index('b') }} {{ "
    "names.0 }}",
]  # fmt: skip


@pytest.mark.parametrize("template", ALIKE)
def test_shorter_code_renders_what_the_plain_sandbox_does(template):
    values = {
        "n": 0.25, "names": ["a", "b", "c"], "graph": {"ego": {"id": "<v1>"}}, "big": 1e20, "nan": math.nan,
        "nothing": None,
    }  # fmt: skip
    plain = ImmutableSandboxedEnvironment(undefined=StrictUndefined).from_string(template)
    assert rendered(template, **values) == plain.render(values)


@pytest.mark.parametrize(
    "template",
    ["{{ x * 100 }}", "{{ 100 * x }}", "{{ x | round | int }}", "{{ x.egg }}", "{{ x.ljust(9) }}"],
)
def test_a_text_is_no_number_and_pads_nothing(template):
    with pytest.raises((SecurityError, TypeError, UndefinedError)):
        rendered(template, x="9")


def test_what_draws_is_rendered_each_time():
    template = Template("{% block system %}{{ actions | random }}{{ lipsum() }}{% endblock %}")
    actions = tuple("ABCDEFGH")
    assert len({template.render({"actions": actions}, ("system",))[0] for _ in range(9)}) > 1


@pytest.mark.parametrize("written", ["'\\ud800'", "'%c' | format(55296)", "'é' ~ '\\udfff'"])
def test_half_of_a_surrogate_pair_is_not_written(written: str):
    template = Template(f"{{% block system %}}{{{{ {written} }}}}{{% endblock %}}")
    with pytest.raises(ValueError, match="half of a surrogate pair"):
        template.render({}, ("system",))


@pytest.mark.parametrize("sandbox", [SANDBOX, PLAIN_SANDBOX], ids=["prompts", "chats"])
@pytest.mark.parametrize(
    "written",
    ["''.maketrans", "graph.items", "[''.upper]", "''.upper ~ 1", "graph.keys ~ ''", 
        "['a'] | map('upper')",
     "range", "cycler(1)", "''.upper | string"],
)  # fmt: skip
def test_what_has_no_text_but_its_address_is_not_written(written: str, sandbox: Environment):
    """It would be another text in every process."""
    template = sandbox.from_string(f"{{{{ {written} }}}}")
    with pytest.raises(
        SecurityError, match=r"^an? \w+ has no text; call it, or write what it makes$"
    ):
        template.render(graph={})
