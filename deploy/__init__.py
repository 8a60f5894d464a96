"""How the parts are put together, started and measured."""
