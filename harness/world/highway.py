"""highway-env's roads and vehicles, loaded without its environments.

The package loads its environments whenever one of its modules is imported, and with them pandas,
matplotlib and pygame: .7 of the second that a command took to start. Roads and vehicles need none
of these. Who imports `highway_env` itself later, or a module of it that is not loaded yet, gets all
of it as ever: the same package, with the modules that are here.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec
from types import ModuleType

PACKAGE = "highway_env"
__all__ = [
    "AbstractLane",
    "CircularLane",
    "ControlledVehicle",
    "LineType",
    "MDPVehicle",
    "Road",
    "RoadNetwork",
    "StraightLane",
    "Vehicle",
]


class _Rest(MetaPathFinder, Loader):
    """Load the package where it is imported itself, into the module that its parts are in."""

    def __init__(self, package: ModuleType, spec: ModuleSpec) -> None:
        self.package, self.spec = package, spec

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != PACKAGE:
            return None
        sys.meta_path.remove(self)
        rest = ModuleSpec(name, self, origin=self.spec.origin, is_package=True)
        rest.submodule_search_locations = self.spec.submodule_search_locations
        return rest

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self.package

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__, module.__loader__ = self.spec, self.spec.loader
        assert self.spec.loader is not None
        self.spec.loader.exec_module(module)


@contextmanager
def _alone() -> Iterator[None]:
    """Let modules of the package be imported without what the package itself loads."""
    spec = None if PACKAGE in sys.modules else find_spec(PACKAGE)
    if spec is None:  # it is loaded, or is not installed, which an import says
        yield
        return
    package = sys.modules[PACKAGE] = module_from_spec(spec)
    try:
        yield
    finally:
        del sys.modules[PACKAGE]
        sys.meta_path.insert(0, _Rest(package, spec))


with _alone():
    from highway_env.road.lane import AbstractLane, CircularLane, LineType, StraightLane
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
    from highway_env.vehicle.kinematics import Vehicle
