"""Laws that nobody listed: where one enters, on what it depends, how it is written."""
