"""What users see: the command line, the console, figures and videos."""
