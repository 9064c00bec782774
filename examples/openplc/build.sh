#!/usr/bin/env bash
# Build the runtime of OpenPLC 3 for one program, without its web page, Siemens S7, EtherCAT and DNP3 servers.
# build.sh OPENPLC_V3 PROGRAM.st: OPENPLC_V3 is the folder of its sources; the result is OPENPLC_V3/webserver/core/openplc.
set -euo pipefail
sources=$(realpath "$1")
program=$(realpath "$2")
cd "$sources"
if [ ! -x webserver/iec2c ]; then
  (cd utils/matiec_src && autoreconf -i && ./configure && make -j2 && cp iec2c "$sources/webserver")
fi
# Its own libmodbus: the runtime calls a function that others do not have.
if [ ! -d prefix ]; then
  (cd utils/libmodbus_src && ./autogen.sh && ./configure --prefix="$sources/prefix" && make install)
fi
snap7=$sources/utils/snap7_src/build/bin/linux
[ -e "$snap7/libsnap7.so" ] || make -C utils/snap7_src/build/linux -j2
[ -x webserver/core/glue_generator ] ||
  g++ -std=c++11 utils/glue_generator_src/glue_generator.cpp -o webserver/core/glue_generator

cd webserver
./iec2c -f -l -p -r -R -a "$program"
mv -f POUS.c POUS.h LOCATED_VARIABLES.h VARIABLES.csv Config0.c Config0.h Res0.c core
cd core
cp hardware_layers/blank.cpp hardware_layer.cpp
cp ../../utils/snap7_src/wrapper/oplc_snap7.* .
cp debug.blank debug.cpp
if [ -e dnp3.cpp ]; then mv dnp3.cpp dnp3.disabled; cp dnp3_dummy.disabled dnp3_dummy.cpp; fi
g++ -std=gnu++11 -w -I lib -c Config0.c Res0.c
./glue_generator
g++ -std=gnu++11 -w -fpermissive -pthread -I lib -I "$sources/prefix/include/modbus" ./*.cpp Config0.o Res0.o -o openplc \
  -L "$sources/prefix/lib" -lmodbus -L "$snap7" -lsnap7 -lrt "-Wl,-rpath,$sources/prefix/lib:$snap7"
