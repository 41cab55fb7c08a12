# Read by llama.cpp's own CMakeLists (CMAKE_PROJECT_llama.cpp_INCLUDE): its tools' common code is half of the
# build, nothing here uses it, and no -D turns it off, since llama-cpp-python forces it on.
set(LLAMA_BUILD_COMMON OFF)
