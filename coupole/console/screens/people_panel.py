"""Panel of the people who may sign in, for engineers: add and remove accounts, change roles."""

from __future__ import annotations

from nicegui import ui

from coupole.console.people.accounts import SHORTEST_PASSWORD, Account, Role
from coupole.console.screens.parts import Choice, button, panel, sure, with_label
from coupole.console.screens.visit import Visit

_ROLES = {
    "observer": "observer: looks",
    "operator": "operator: runs plans",
    "engineer": "engineer: keeps accounts, calibrates",
}


class PeoplePanel:
    """The accounts of this console."""

    def __init__(self, visit: Visit) -> None:
        self._visit = visit
        with panel("People"):
            self._rows = ui.column().classes("gap").style("width:100%").props("data-name=people")
            with ui.expansion("Add somebody").classes("printed").props("data-name=add-person"):
                self._name = ui.input("name").props("outlined dense data-name=new-name")
                self._password = ui.input(
                    f"password, at least {SHORTEST_PASSWORD} characters", password=True
                ).props("outlined dense autocomplete=new-password data-name=new-password")
                self._role = Choice("role", _ROLES, name="new-role", value="operator")
                button("Add", self._add, name="add", kind="main")
        self._show()

    def _show(self) -> None:
        self._rows.clear()
        with self._rows:
            for account in self._visit.service.accounts.all_accounts():
                self._row(account)

    def _row(self, account: Account) -> None:
        with ui.row().classes("person"):
            ui.label(account.name).classes("person-name")

            async def change() -> None:
                await self._change(account, Role.of(role.value))

            async def remove() -> None:
                await self._remove(account)

            words, name = f"role of {account.name}", f"role-{account.name}"
            role = Choice(words, _ROLES, change, name=name, value=account.role.word)
            with_label(
                button("Remove", remove, name=f"remove-{account.name}", kind="flat"), f"remove {account.name}"
            )

    async def _add(self) -> None:
        accounts, name, role = self._visit.service.accounts, self._name.value.strip(), Role.of(self._role.value)
        password, self._password.value = self._password.value, ""
        account = await self._visit.act(
            f"add account {name} ({role.word})",
            lambda: accounts.add(name, password, role),
            role=Role.ENGINEER,
            acts=False,
            done_text=f"{name} may sign in",
        )
        if account is not None:
            self._name.value = ""
        self._show()

    async def _change(self, account: Account, role: Role) -> None:
        service, name = self._visit.service, account.name
        await self._visit.act(
            f"make {name} {role.word}",
            lambda: service.accounts.change_role(name, role),
            role=Role.ENGINEER,
            acts=False,
            done_text=f"{name} is {role.word} now",
        )
        self._show()

    async def _remove(self, account: Account) -> None:
        service, name = self._visit.service, account.name
        if await sure(f"Remove {name}?", f"{name} is signed out and cannot sign in any more.", "Remove"):
            await self._visit.act(
                f"remove account {name}",
                lambda: service.accounts.remove(name),
                role=Role.ENGINEER,
                acts=False,
                done_text=f"{name} is removed",
            )
            self._show()
