"""The family `env`: scenarios that are environments of highway-env."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from harness.core.depth import shallow
from harness.core.errors import UserError, printable
from harness.core.files import text_of

if TYPE_CHECKING:
    from harness.world.scenario import Scenario

ENV, CONFIG = "env", "env_config"  # the options of commands that take a scenario


class Environments:
    """Make scenarios of environments of highway-env, by names such as `env:merge-v0:config={...}`.

    `options` are those of commands that take a scenario, by name, with their help. Methods are
    those of `Family`: they make a name of what is typed, split settings off it, allow the module
    that it needs, and return the scenario.
    """

    heading = "Environments"
    options: ClassVar[Mapping[str, str]] = {
        ENV: "A highway-env environment to use instead of a scenario: merge-v0, or "
        "my_package:MyEnv-v0 for one of your own.",
        CONFIG: "With --env: JSON file with changes to its configuration.",
    }

    def named(self, typed: Mapping[str, str]) -> str:
        if ENV not in typed:
            raise UserError("--env-config changes an environment; give --env as well")
        from harness.extensions.environments import environment

        name = environment.named(typed[ENV])
        environment.allow(name)
        if CONFIG not in typed:
            return name
        file = Path(typed[CONFIG])
        try:
            name = environment.named(typed[ENV], shallow(json.loads(text_of(file, "settings"))))
            name.encode()  # JSON can write half a character, which no file can hold
        except (OSError, ValueError, RecursionError) as error:
            raise UserError(
                f"--env-config {printable(file)} cannot be read ({printable(error)}); give a JSON "
                "file"
            ) from None
        return name

    def scenario(self, name: str) -> "Scenario":
        from harness.extensions.environments.world import scenario  # imports highway-env

        return scenario(name)

    def typed(self, text: str, folder: str) -> list[str]:
        return [text]

    def split(self, text: str) -> tuple[str, str | None]:
        from harness.extensions.environments import environment

        return environment.split(text)

    def joined(self, name: str, settings: Sequence[str]) -> str:
        from harness.extensions.environments import environment

        return environment.joined(name, settings)

    def allow(self, name: str) -> str | None:
        from harness.extensions.environments import environment

        if not (module := environment.module_of(name)):
            return None
        environment.allow(name)
        module_name = printable(module)
        variable = environment.IMPORTS
        return f"commands that read it import {module_name}, if you set {variable}={module_name}"

    def kept_in(self, name: str, folder: Path) -> None:
        pass  # a name has all that an environment is made from


ENVIRONMENTS = Environments()
