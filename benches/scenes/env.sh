# big arrays come from the heap and stay there: page faults cost more than the arithmetic
export MALLOC_MMAP_THRESHOLD_=8000000000 MALLOC_TRIM_THRESHOLD_=16000000000 MALLOC_TOP_PAD_=1000000000
export PYTHONDONTWRITEBYTECODE=1
