"""Commands that must be refused, and what they leave as it was."""

from deimos.app import cli


def refused(arguments, capfd):
    """Run a command that must fail; returns the one line that it says."""
    code = cli.main([str(argument) for argument in arguments])
    out, err = capfd.readouterr()
    assert code == 2, err
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("deimos: ")
    assert "Traceback" not in err
    return err


def contents(path):
    """Every file below a folder with what it holds, and every folder."""
    return {file: file.read_bytes() if file.is_file() else None for file in sorted(path.rglob("*"))}
