"""Models of a kit that are built at their first use."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from hybrid_mpc.model.model import HybridModel


class ModelsAtUse(Mapping[str, HybridModel]):
    """Models by name; each is built at its first use and kept, since a loop needs only one or two of them.

    Args:
        names: Names of the models, in order.
        build: Builds a model by name, or raises an InputError.

    Example:
        >>> models = ModelsAtUse(["prior"], lambda name: print("built", name))
        >>> list(models), models["prior"], models["prior"]
        built prior
        (['prior'], None, None)
    """

    def __init__(self, names: Sequence[str], build: Callable[[str], HybridModel]) -> None:
        self._names, self._build = tuple(names), build
        self._built: dict[str, HybridModel] = {}

    def __getitem__(self, name: str) -> HybridModel:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._built:
            self._built[name] = self._build(name)
        return self._built[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return f"<models {', '.join(self._names)}>"
