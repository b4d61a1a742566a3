"""Published recordings: what each study is simulated with, one file for each data set."""
