"""One file, one goal selector: it holds a frozen dataclass ``Config`` (see ``deimos.selector.SelectorConfig``)."""
