"""A template reads a scene's members, and nothing that the sandbox forbids."""

import pytest
from jinja2 import StrictUndefined, UndefinedError
from jinja2.exceptions import SecurityError
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
