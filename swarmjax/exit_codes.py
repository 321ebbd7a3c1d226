"""Exit codes of the commands."""

FAILED = 1  # what was asked for could not be done, or two things differ
USER_ERROR = 2  # a setting, a file or a word of the command line is unsound
REQUEUE = 75  # EX_TEMPFAIL of sysexits.h: stopped by a scheduler, to be started again
INTERRUPTED = 130  # 128 + SIGINT, as a shell gives it
