"""What a user's mistake must leave on the terminal."""


def bad(result):
    """The one line of a mistake."""
    assert result.exit_code == 2, result.output
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("dddas: ")
    assert "Traceback" not in result.output
    return lines[0]
