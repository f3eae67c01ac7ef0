"""One file, one goal selector: a frozen dataclass ``Config``; see ``deimos.goals.selector.SelectorConfig``."""
