"""The site: mkdocs hooks, and what the pages say of the code, written by the code. `make docs` builds it; nothing here is installed."""
