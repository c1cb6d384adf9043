"""Joint maximum likelihood of both transforms from all corners of all captures."""
