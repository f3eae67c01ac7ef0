"""Attackers that the policies of a study meet in addition to those of its cells."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from deimos.checks import RunError
from deimos.run.attack import attacker
from deimos.study.plan import Cell, parse_seeds
from deimos.study.tables import check_table


@dataclass(frozen=True, kw_only=True)
class AttackRound:
    """Attackers that some policies of a study meet in addition to those of its cells."""

    attackers: tuple[str, ...]
    """Their names, at least 1."""
    seeds: tuple[int, ...] = ()
    """Seeds of the policies; none for all."""

    def __post_init__(self) -> None:
        if not self.attackers:
            raise ValueError("attackers must be one or more names, got none.")
        for name in self.attackers:
            attacker(name)

    def meets(self, cell: Cell) -> bool:
        """Whether the policy of a cell is one of them."""
        return not self.seeds or cell.config.seed in self.seeds


def rounds(description: dict) -> list[AttackRound]:
    """The ``[[attack]]`` of a study: ``attackers``, names, and the ``seeds`` (see ``parse_seeds``) that meet them."""
    found = []
    for table in description.get("attack", []):
        check_table("An [[attack]]", table, {"attackers": (list, str)}, {"seeds"})
        seeds = tuple(parse_seeds(table["seeds"])) if "seeds" in table else ()
        try:
            found.append(AttackRound(attackers=tuple(table.get("attackers", ())), seeds=seeds))
        except ValueError as error:
            raise RunError(f"An [[attack]]: {error}") from error
    return found


def check_rounds(rounds: Iterable[AttackRound], cells: Iterable[Cell]) -> None:
    """Raise ``RunError`` if a policy cannot meet an attacker that it is to meet: ``pooled`` takes a file, say."""
    cells = list(cells)
    for each in rounds:
        for cell in filter(each.meets, cells):
            try:
                replace(cell.config.eval, attackers=each.attackers)
            except ValueError as error:
                raise RunError(f"Environment '{cell.environment}' cannot be attacked: {error}") from error
