"""What a person meets: the command line, the console, figures and videos."""
