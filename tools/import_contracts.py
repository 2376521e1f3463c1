"""A contract for import-linter: a package, and all that it may import. Other imports are forbidden."""

from __future__ import annotations

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
        """One line for each import that is not allowed."""
        allowed = {str(self.package), *map(str, cast(Iterable[object], self.allowed_modules or ()))}
        own = {str(self.package), *graph.find_descendants(str(self.package))}
        wrong = [
            (importer, imported)
            for importer in sorted(own)
            for imported in sorted(graph.find_modules_directly_imported_by(importer))
            if imported != str(self.package).partition(".")[0]
            and not any(imported == module or imported.startswith(f"{module}.") for module in allowed)
        ]
        return ContractCheck(kept=not wrong, metadata={"wrong": wrong})

    def render_broken_contract(self, check: ContractCheck) -> None:
        for importer, imported in check.metadata["wrong"]:
            output.print_error(f"{importer} imports {imported}, which {self.package} may not use")
