"""The `sms` command: parse, call one function, print."""
