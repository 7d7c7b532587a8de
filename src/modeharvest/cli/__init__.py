"""The command line: ``root`` joins the commands and turns errors into exit codes."""
