"""How parts come in: hooks, components, the manager that loads plugins, and the registries."""
