"""The command line: one thin module per verb, loaded when the verb is used."""
