"""Studies as cases: a TOML file says what to ask of which specimen; ``modeharvest study`` asks."""
