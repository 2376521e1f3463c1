"""Contracts for import-linter: a package may import only what is listed for it; no circles."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import cast

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output


class AllowListContract(Contract):
    """`package` and its modules may import themselves, `allowed_modules` with their submodules, and the package's
    parent, for its version.

    Only the project's own packages are checked; other libraries are always allowed.
    """

    package = fields.StringField()
    allowed_modules = fields.SetField(subfield=fields.StringField(), required=False)

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Yield one line for each import that is not allowed."""
        allow_list = {str(self.package), *map(str, cast(Iterable[object], self.allowed_modules or ()))}
        own_modules = {str(self.package), *graph.find_descendants(str(self.package))}
        wrong = [
            (importer, dependency)
            for importer in sorted(own_modules)
            for dependency in sorted(graph.find_modules_directly_imported_by(importer))
            if dependency != str(self.package).partition(".")[0]
            and not any(dependency == module or dependency.startswith(f"{module}.") for module in allow_list)
        ]
        return ContractCheck(kept=not wrong, metadata={"wrong": wrong})

    def render_broken_contract(self, check: ContractCheck) -> None:
        for importer, dependency in check.metadata["wrong"]:
            output.print_error(f"{importer} imports {dependency}, which {self.package} may not use")


class NoCirclesContract(Contract):
    """No module imports itself through others. Imports inside functions, and imports for types only, count too."""

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Yield one line for each circle, with a shortest way around it."""
        circles: list[list[str]] = []
        for module in sorted(graph.modules):
            if any(module in circle for circle in circles):
                continue
            way = _way_round(graph, module)
            circles += [way] if way else []
        return ContractCheck(kept=not circles, metadata={"circles": circles})

    def render_broken_contract(self, check: ContractCheck) -> None:
        for circle in check.metadata["circles"]:
            output.print_error(f"a circle: {' imports '.join([*circle, circle[0]])}")


def _way_round(graph: ImportGraph, module: str) -> list[str]:
    """Return the modules on a way of imports from `module` back to it; empty if there is none."""
    before: dict[str, str] = {}
    waiting = deque([module])
    while waiting:
        importer = waiting.popleft()
        for dependency in sorted(graph.find_modules_directly_imported_by(importer)):
            if dependency == module:
                way = [importer]
                while way[-1] != module:
                    way.append(before[way[-1]])
                return way[::-1]
            if dependency not in before:
                before[dependency] = importer
                waiting.append(dependency)
    return []
