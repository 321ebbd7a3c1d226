"""Exit codes of the commands."""

FAILED = 1  # the command could not do its work, or a comparison found a difference
USER_ERROR = 2  # a setting, a file or a word of the command line is invalid
REQUEUE = 75  # EX_TEMPFAIL of sysexits.h: a scheduler stopped the run; start the run again
INTERRUPTED = 130  # 128 + SIGINT, the code that shells use
