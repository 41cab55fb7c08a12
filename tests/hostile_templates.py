"""Templates that would fill memory or never end, by the kind of thing they do.

Those that build a text do so in a namespace, `TWICE` and `TIMES` times.
"""

DOUBLE = (
    "{%% set ns = namespace(t=%s) %%}{%% for i in range(60) %%}{%% set ns.t = %s %%}{%% endfor "
    "%%}%s"
)


def _built(first: str, step: str, use: str = "{{ ns.t | length }}") -> str:
    return DOUBLE % (first, step, use)


def _long(use: str, times: int = 18, unit: str = "'ab c-d, '") -> str:
    """A template that uses a text of some megabytes."""
    return (
        f"{{% set ns = namespace(t={unit}) %}}{{% for i in range({times}) %}}{{% set ns.t = ns.t ~ "
        f"ns.t %}}{{% endfor %}}{use}"
    )


_FOREVER = "{% for a in range(99999) %}{% for b in range(99999) %}%s{% endfor %}{% endfor %}"
# a list whose text is 2 ** 60 times as long as what it takes in memory
_SHARED = ("[0]", "[ns.t, ns.t]")
_PAIRS = ("(0,)", "(ns.t, ns.t)")

# Whatever these do costs too much; no environment renders them.
TEMPLATES = {
    "~": _built("'ab'", "ns.t ~ ns.t"),
    "+ of texts": _built("'ab'", "ns.t + ns.t"),
    "+ of lists": _built("[1]", "ns.t + ns.t"),
    "a block that is set": _built("'ab'", "x").replace("{% set ns.t", 
        "{% set x %}{{ ns.t }}{{ ns.t "
        "}}{% endset %}{% set ns.t"),
    "replace": _built("'ab'", "ns.t | replace('a', 'abababab')"),
    "replace with nothing": _built("'ab'", "ns.t.replace('', 'abababab')"),
    "join": _built("'ab'", "ns.t | join(ns.t)"),
    "method join": _built("'ab'", "ns.t.join(ns.t)"),
    "constants": "{{ 'aaaaaaaa'" + " | replace('a', 'aaaaaaaaa')" * 40 + " }}",
    "a filter's block": _FOREVER.replace("%s", 
        "{% filter replace('a', "
        "'aaaaaaaaaaaaaaaa') %}aaaaaaaa{% "
        "endfilter %}"),
    "batch": "{{ [1] | batch(100000000000, 0) | list }}",
    "slice": "{{ [1] | slice(100000000000) | list }}",
    "round": "{{ 1.5 | round(1000000000, 'ceil') }}",
    "lipsum": "{{ lipsum(n=100000) }}{{ lipsum(n=1, max=1000000000) }}",
    "powers": "{{ 9 ** 9 ** 9 }}{{ (9 ** 60) ** 60 ** 60 }}{% set ns = namespace(n=9) %}"
    "{% for i in range(60) %}{% set ns.n = ns.n * ns.n %}{% endfor %}",
    "products": 
        "{% set ns = namespace(n=9) %}{% for i in range(60) %}{% set ns.n = ns.n * ns.n %}{% "
        "endfor %}",
    "sums": _FOREVER.replace("%s", "{% set ns.n = ns.n + ns.n %}").replace("{% for a", 
        "{% set ns = namespace(n=9) %}{% for a", 1),
    "loops": _FOREVER.replace("%s", ""),
    "loops that write": _FOREVER.replace("%s", "xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx"),
    "loops with a condition": 
        "{% for a in range(99999) %}{% for b in range(99999) if b > 99999 %}{% endfor %}{% endfor "
        "%}",
    "loops inside filters": 
        "{% for a in range(99999) %}{% set x = range(99999) | map('abs') | select('gt', 99999) | "
        "list %}{% endfor %}",
    "a long constant": "{% for a in range(99999) %}{{ '" + "x" * 50000 + "' }}{% endfor %}",
    "macros": 
        "{% macro m(n) %}{% if n < 60 %}{{ m(n + 1) }}{{ m(n + 1) }}{% endif %}{% endmacro %}{{ "
        "m(0) }}",
    "a macro without end": "{% macro m() %}{{ m() }}{% endmacro %}{{ m() }}",
    "calls": "{% macro m() %}{{ caller() }}{{ caller() }}{% endmacro %}"
    "{% macro n(i) %}{% if i < 60 %}{% call m() %}{{ n(i + 1) }}{% endcall %}{% endif %}{% "
    "endmacro %}{{ n(0) }}",
    "recursive loops": 
        "{% for a in [1, 1] recursive %}{{ loop([1, 1]) if "
        "loop.depth < 60 else 0 }}{% endfor %}",
    "a shared list as text": _built(*_SHARED, "{{ ns.t }}"),
    "a shared list beside text": _built(*_SHARED, "{{ 'a' ~ ns.t }}"),
    "a shared list in a format": _built(*_SHARED, "{{ '%s' | format(ns.t) }}"),
    "a shared list as JSON": _built(*_SHARED, "{{ ns.t | tojson }}"),
    "a shared list in a list": _built(*_SHARED, "{{ ns.t in [[ns.t]] }}"),
    "shared lists compared": _built(*_SHARED, "{% set a = ns.t %}").replace("{% set a", 
        "{% set ns.u = ns.t %}{% set a")
    + _built(*_SHARED, "").replace("ns.", "no.").replace("set ns", "set no") + "{{ ns.t == no.t }}",
    "a shared pair as a key": _built(*_PAIRS, "{{ {ns.t: 1} }}"),
    "a shared pair looked up": _built(*_PAIRS, "{{ {'a': 1}[ns.t] }}"),
    "a shared mapping": _built("{}", "dict(a=ns.t, b=ns.t)", "{{ ns.t }}"),
    "shared lists summed": _built("[1]", "[ns.t, ns.t] | sum(start=[])"),
    "many lists": _FOREVER.replace("%s", 
        "{% set ns.t = [ns.t, "
        "range(99999) | list] %}").replace("{% for a", "{% set ns = namespace(t=1) %}{% for a", 1),
    "many texts": _long(
        "{% for i in range(99999) %}{% set ns.u = "
        "[ns.u, ns.t | upper] %}{% endfor %}", 12),
    "many slices": _long(
        "{% for i in range(99999) %}{% set ns.u = "
        "[ns.u, ns.t[1:]] %}{% endfor %}", 12),
    "many searches": _long(
        "{% for i in range(99999) %}{% if 'ab c-e' "
        "in ns.t %}{% endif %}{% endfor %}"),
    "many copies": _long("{{ ns.t }}" * 5000),
    "many tests": _long("{% for i in range(99999) %}{% if ns.t is lower %}{% endif %}{% endfor %}"),
    "splitting": _long(
        "{% for i in range(99999) %}{% set ns.u = "
        "[ns.u, ns.t.split()] %}{% endfor %}", 12),
    "wordwrap": _long("{{ ns.t | wordwrap(1, true, 'xxxxxxxxxxxxxxxxxx') }}"),
    "urlize": _long("{{ ns.t | urlize }}", 16, "'a@a.http://'"),
    "striptags": _long("{{ ns.t | striptags }}", 16, "'<a<!--'"),
    "pprint": 
        "{% set ns = namespace(t=1) %}{% for i in range(900) %}{% set ns.t = [ns.t, i] %}{% "
        "endfor %}{{ ns.t | pprint }}",
    "JSON with an indent": "{{ [[1]] | tojson(indent=10000000000) }}",
    "a width": "{{ '%99999999999d' | format(1) }}",
    "a precision": "{{ '%.99999999999f' | format(1) }}",
    "a width that is given": "{{ '%*d' | format(99999999999, 1) }}",
    "a sorted range": "{% for i in range(99999) %}{% set x = range(99999) | sort %}{% endfor %}",
    "a number of many digits": _long("{{ ns.t | int(0, 16) }}", 20, "'f'"),
    "bytes of a number": "{{ (1).to_bytes(10 ** 10, 'big') }}",
    "padded bytes": "{{ 'a'.encode().center(10 ** 10) }}",
    "a table of letters": "{{ 'aaaa'.translate({97: 'aaaaaaaa'}) }}",
    "deep brackets": "{{ " + "(" * 60000 + "1" + ")" * 60000 + " }}",
    "deep filters": "{{ 1" + "|e" * 50000 + " }}",
    "deep loops": "{% for i in [1] %}" * 60 + "{% endfor %}" * 60,
    "a long template": "x" * 300000,
}  # fmt: skip

# Prompt templates refuse these as names or operators; chat templates know them, and count what they
# make.
PADDING = {
    "multiplied": "{{ 'a' * 10 ** 10 }}",
    "multiplied lists": _built("[1]", "ns.t * 1000"),
    "% with a width": "{{ '%99999999999d' % 1 }}",
    "% with a named width": "{{ '%(()())99999999999d' % {'()()': 1} }}",
    "% many times": _long("{{ ns.t % {'a': ns.t} }}", 12, "'%(a)s'"),
    "format with a width": "{{ '{:99999999999}'.format(1) }}",
    "format with a width that is given": "{{ '{:{}}'.format(1, 99999999999) }}",
    "center": "{{ 'a' | center(10 ** 11) }}",
    "constants that are padded": 
        "{% for i in range(99999) %}{{ 'a' | "
        "center(1000000) }}{% endfor %}",
    "indent": "{{ 'a\nb' | indent(10 ** 10) }}",
    "indent with a text": _long("{{ ns.t | indent(ns.t) }}", 16, "'\n '"),
    "ljust": 
        "{{ 'a'.ljust(10 ** 11) }}{{ ('a' | attr('ljust'))(10 ** 11) }}{{ 'a'['ljust'](10 ** 11) "
        "}}",
    "zfill": "{{ 'a'.zfill(10 ** 11) }}",
    "expandtabs": "{{ '\t'.expandtabs(10 ** 10) }}",
}  # fmt: skip
