"""A template reads a scene's members, and nothing that the sandbox forbids."""

import pytest
from jinja2 import StrictUndefined, UndefinedError
from jinja2.exceptions import SecurityError, TemplateAssertionError
from jinja2.sandbox import ImmutableSandboxedEnvironment

from harness.prompts.versions import LOOP, Sandbox

SANDBOX = Sandbox(undefined=StrictUndefined)


def rendered(template: str, **context: object) -> str:
    return SANDBOX.from_string(template).render(context)


def test_a_member_is_read_by_its_name_even_where_a_method_has_it_too():
    assert (
        rendered("{{ graph.items }}, {{ graph.ego.id }}", graph={"items": 3, "ego": {"id": "v1"}}) == "3, v1"
    )


@pytest.mark.parametrize("name", sorted(LOOP))
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
     "{{ '%3000000000d' | format(1) }}", "{{ '%*d' | format(3000000000, 1) }}", "{{ '%3000000000d' % 1 }}",
     "{{ '{:3000000000}'.format(1) }}"],
)  # fmt: skip
def test_no_template_fills_memory(template):
    with pytest.raises(SecurityError):
        rendered(template)


@pytest.mark.parametrize("template", ["{{ 'a' | center(3000000000) }}", "{{ 'a' | indent(3000000000) }}"])
def test_filters_that_pad_are_gone(template):
    with pytest.raises(TemplateAssertionError):
        rendered(template)


def test_numbers_are_multiplied_and_formatted():
    assert rendered("{{ (0.25 * 100) | round | int }} {{ '%.2f' | format(0.5) }} {{ 7 % 4 }}") == "25 0.50 3"
