# Read by llama.cpp's own CMakeLists (CMAKE_PROJECT_llama.cpp_INCLUDE): its tools' common code is half of the
# build, nothing here uses it, and no -D turns it off, since llama-cpp-python forces it on.
set(LLAMA_BUILD_COMMON OFF)
# What reads pictures (mtmd) is fifty files that compile in a third of the time as one, but for its helpers,
# which refuse to be part of it. It lays out graphs, and ggml computes: how fast its own code is shows nowhere.
set(mtmd ${CMAKE_CURRENT_SOURCE_DIR}/tools/mtmd)
cmake_language(EVAL CODE "
    cmake_language(DEFER DIRECTORY ${CMAKE_SOURCE_DIR} CALL
        set_target_properties mtmd PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
    cmake_language(DEFER DIRECTORY ${CMAKE_SOURCE_DIR} CALL
        set_source_files_properties ${mtmd}/mtmd-helper.cpp ${mtmd}/mtmd-helper-gen.cpp
        DIRECTORY ${mtmd} PROPERTIES SKIP_UNITY_BUILD_INCLUSION ON)
    cmake_language(DEFER DIRECTORY ${CMAKE_SOURCE_DIR} CALL target_compile_options mtmd PRIVATE -O1)")
