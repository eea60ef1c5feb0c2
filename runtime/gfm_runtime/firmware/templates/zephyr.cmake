# @MADE@
if(CONFIG_GFM)
  zephyr_include_directories(..)
  zephyr_library_named(gfm)
  # A fused multiply-add rounds once where the kernel rounds twice: the bits would differ.
  zephyr_library_compile_options(-ffp-contract=off -fno-math-errno)
  zephyr_library_sources(@ZEPHYR_SOURCES@)
endif()
